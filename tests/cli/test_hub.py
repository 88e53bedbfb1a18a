"""``bidex-meta push`` and ``pull``: over a folder, over the hub's cache without a network, and what is uploaded."""

import json
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import pytest

from bidex_meta.cli import main
from tests.pages import ROOT

HAND_OVER = ROOT / "results" / "teachers" / "HandOver"
MT20 = ROOT / "assets" / "policies" / "MT20"


def test_a_policy_goes_through_a_folder_and_plays(shown, refused, tmp_path: Path) -> None:
    hub, out = f"folder:{tmp_path / 'hub'}", tmp_path / "mine"
    assert shown("push", HAND_OVER, hub) == f"bidex-meta pull {hub}\n"
    assert "is not empty" in refused("push", HAND_OVER, hub)
    assert shown("pull", hub, "--out", out) == f"{out}\n"
    assert "is not empty" in refused("pull", hub, "--out", out)
    found = json.loads(shown("evaluate", out, "--episodes", "1", "--json"))
    assert found["policy"]["classes"]["HandOver"]["success"] > 0.4
    (checkpoint,) = (out / "checkpoints").iterdir()
    assert checkpoint.read_bytes() == (HAND_OVER / "checkpoints" / checkpoint.name).read_bytes()


def test_a_card_is_made_from_the_run_and_read_by_the_hub(shown, tmp_path: Path) -> None:
    hub = pytest.importorskip("huggingface_hub", reason="needs the extra hub")
    shown("push", MT20, f"folder:{tmp_path}")
    card = hub.ModelCard((tmp_path / "README.md").read_text())
    classes = json.loads((MT20 / "evaluation.json").read_text())["policy"]["classes"]
    mean = sum(row["success"] for row in classes.values()) / 20
    (result,) = card.data.eval_results
    assert (result.dataset_name, round(mean, 4)) == ("MT20", result.metric_value)
    assert {"MT20", "dagger"} <= {*card.data.tags} and card.data.license == "apache-2.0"
    row, versions = classes["HandOver"], json.loads((MT20 / "versions.json").read_text())
    assert f"| HandOver | {100 * row['success']:.1f} % | {row['return']:.4g} |" in card.text
    assert f"| commit | {versions['git']['commit'][:6]}" in card.text


def test_without_a_network_the_cache_of_the_hub_serves(shown, refused, tmp_path: Path, monkeypatch) -> None:
    # The package loads its modules on demand: its `constants` is no attribute before somebody has imported it.
    constants = pytest.importorskip("huggingface_hub.constants", reason="needs the extra hub")
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    said = refused("pull", "me/hand-over")
    assert "LocalEntryNotFoundError" in said and "folder:PATH" in said
    kept = tmp_path / "cache" / "models--me--hand-over"
    shown("push", HAND_OVER, f"folder:{kept / 'snapshots' / ('0' * 40)}")
    (kept / "refs").mkdir()
    (kept / "refs" / "main").write_text("0" * 40)
    assert shown("pull", "me/hand-over") == "pulled/hand-over\n"
    assert (tmp_path / "pulled" / "hand-over" / "config.json").is_file()


def test_an_upload_holds_the_run_and_its_card(shown, refused, monkeypatch) -> None:
    hub = pytest.importorskip("huggingface_hub", reason="needs the extra hub")
    calls = []
    for name in ("create_repo", "create_commit"):
        monkeypatch.setattr(hub, name, lambda *words, _name=name, **options: calls.append((_name, words, options)))
    monkeypatch.setattr(hub, "CommitOperationAdd", lambda *words: SimpleNamespace(path=words[0], content=words[1]))
    assert shown("push", HAND_OVER, "me/hand-over", "--private") == "bidex-meta pull me/hand-over\n"
    (_, words, made), (_, _, commit) = calls
    assert words == ("me/hand-over",) and made == {"repo_type": "model", "private": True, "exist_ok": True}
    paths = [each.path for each in commit["operations"]]
    assert {"config.json", "README.md"} < {*paths} and sum(path.endswith(".pt") for path in paths) == 1
    assert "for a data set alone" in refused("push", HAND_OVER, "datasets/me/hand-over")


def test_a_data_set_goes_through_a_folder_and_minari_makes_its_environment(shown, tmp_path: Path, monkeypatch) -> None:
    minari = pytest.importorskip("minari", reason="needs the extra data")
    data = tmp_path / "HandOver" / "random-v0"
    words = ["--task", "HandOver", "--size", "80", "--num-envs", "2", "--threads", "1", "--device", "cpu"]
    assert main(["record", "random", *words, "--out", str(data)]) == 0
    shown("push", data, f"folder:{tmp_path / 'hub'}")
    pulled = tmp_path / "pulled" / "HandOver" / "random-v0"
    shown("pull", f"folder:{tmp_path / 'hub'}", "--out", pulled)
    assert "\n# HandOver/random-v0\n" in (pulled / "README.md").read_text()
    shown("data", "check", pulled)  # digests and all
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "pulled"))
    dataset = minari.load_dataset("HandOver/random-v0")
    env = dataset.recover_environment()
    assert env.spec is not None and env.spec.id == "bidex-meta/HandOver-v1"
    assert isinstance(env, gymnasium.Env) and env.observation_space.shape == dataset.observation_space.shape
    env.close()


def test_what_is_no_run_is_refused(refused, tmp_path: Path) -> None:
    assert "has no config.json" in refused("push", tmp_path, f"folder:{tmp_path / 'hub'}")
    assert "holds neither a run's config.json nor a data set" in refused("pull", f"folder:{tmp_path}")

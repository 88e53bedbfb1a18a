"""``bidex-meta push`` and ``pull``: over a folder, over the hub's cache without a network, and what is uploaded."""

import json
import os
import resource
import shutil
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import pytest

from bidex_meta.cli import main
from bidex_meta.runs import RunFolder
from bidex_meta.runs.evaluations import ClassSummary, MetaTestEvaluation, SplitSummary, Summary, evaluation_json
from tests.fakes import trained_run
from tests.pages import ROOT

HAND_OVER = ROOT / "results" / "teachers" / "HandOver"
MT20 = ROOT / "results" / "MT20-dagger-seed0"


def test_a_policy_goes_through_a_folder_and_plays(shown, refused, tmp_path: Path) -> None:
    hub, out = f"folder:{tmp_path / 'hub'}", tmp_path / "mine"
    assert shown("push", HAND_OVER, hub) == f"bidex-meta pull {hub}\n"
    card = (tmp_path / "hub" / "README.md").read_text()
    assert "bidex-meta pull folder:hub --out policy" in card and str(tmp_path) not in card
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


@pytest.mark.parametrize("steps", [3489791, None])
def test_a_card_has_no_results_of_another_checkpoint(shown, tmp_path: Path, steps: int | None) -> None:
    run = Path(shutil.copytree(HAND_OVER, tmp_path / "run"))
    _damage(run / "evaluation.json", "steps", steps)
    shown("push", run, f"folder:{tmp_path / 'hub'}")
    card = (tmp_path / "hub" / "README.md").read_text()
    assert "results are left out, because evaluation.json is not of the newest checkpoint" in card
    assert "model-index" not in card and "| HandOver | " not in card and "evaluated on" not in card
    assert "| steps | 3,489,792 |" in card


def test_a_card_of_a_learner_that_adapts_has_its_meta_test(shown, tmp_path: Path) -> None:
    run = Path(shutil.copytree(trained_run("promp"), tmp_path / "run"))
    loaded = RunFolder.open(run).checkpoints.load()
    assert loaded is not None
    before, after = (Summary(classes={"Switch": ClassSummary(success=x, mean_return=9.0)}) for x in (0.25, 0.75))
    split = SplitSummary(shots=2, rollouts=7, trials=1, before=before, after=after, by_shot=[before, after])
    evaluation = MetaTestEvaluation(splits={"test": split}, steps=loaded[1])
    (run / "evaluation.json").write_text(json.dumps(evaluation_json(evaluation)))
    shown("push", run, f"folder:{tmp_path / 'hub'}")
    card = (tmp_path / "hub" / "README.md").read_text()
    assert "Results on test tasks of" in card and "| Switch | 25.0 % | 9 |" in card
    assert "After 2 shots of 7 episodes:\n\n| class | success | return |\n|---|---|---|\n| Switch | 75.0 %" in card


def test_a_card_names_steps_split_and_randomisation_of_its_results(shown, tmp_path: Path) -> None:
    run = Path(shutil.copytree(HAND_OVER, tmp_path / "run"))
    shown("push", run, f"folder:{tmp_path / 'usual'}")
    assert "of the policy of 3,489,792 steps on HandOver:\n" in (tmp_path / "usual" / "README.md").read_text()
    _damage(run / "evaluation.json", "split", "test")
    _damage(run / "evaluation.json", "randomisation", {"action_noise": 1.0})
    shown("push", run, f"folder:{tmp_path / 'hub'}")
    card = (tmp_path / "hub" / "README.md").read_text()
    assert "of the policy of 3,489,792 steps on HandOver, split test, randomised:\n" in card
    assert '"dataset": {"name": "HandOver, split test, randomised", "type": "HandOver"}' in card


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
    assert "only for a data set" in refused("push", HAND_OVER, "datasets/me/hand-over")


def test_a_data_set_goes_through_a_folder_and_minari_makes_its_environment(shown, tmp_path: Path, monkeypatch) -> None:
    minari = pytest.importorskip("minari", reason="needs the extra data")
    data = recorded(tmp_path / "HandOver" / "random-v0")
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


METADATA = [None, [], "text", 3, 2.5, True, {"a": [1]}]
FIELDS = {
    "config.json": ["algo", "seed", "steps", "learner", "num_envs"],
    "versions.json": ["packages", "git", "gpus"],
    "evaluation.json": ["policy", "steps"],
}


def _damages() -> list[tuple[str, str, object]]:
    """A file, an entry and a value of another type; ``cut`` and ``whole`` are of the whole file."""
    cases: list[tuple[str, str, object]] = []
    for name, fields in FIELDS.items():
        cases += [(name, "cut", share) for share in (0.0, 0.3, 0.9)]
        cases += [(name, "whole", value) for value in METADATA[:-1]]
        cases += [(name, field, value) for field in fields for value in METADATA]
    return cases


def _damage(path: Path, field: str, value: object) -> None:
    text = path.read_text()
    if field == "cut":
        path.write_text(text[: int(float(str(value)) * len(text))])
    elif field == "whole":
        path.write_text(json.dumps(value))
    else:
        path.write_text(json.dumps(json.loads(text) | {field: value}))


def test_damaged_metadata_of_a_run_are_one_line_or_pushed(tmp_path: Path, capsys) -> None:
    """A value that fits after all (a seed of 3) may pass; nothing ends in another error than ours."""
    cases, told = _damages(), 0
    for number, (name, field, value) in enumerate(cases):
        run = tmp_path / f"run-{number}"
        run.mkdir()
        for each in FIELDS:
            shutil.copyfile(HAND_OVER / each, run / each)
        (run / "checkpoints").mkdir()
        checkpoint = next((HAND_OVER / "checkpoints").glob("*.pt"))
        os.link(checkpoint, run / "checkpoints" / checkpoint.name)
        _damage(run / name, field, value)
        hub = tmp_path / f"hub-{number}"
        code = main(["push", str(run), f"folder:{hub}"])
        errors = capsys.readouterr().err
        assert code in (0, 2) and "Traceback" not in errors and errors.count("\n") <= 1, (name, field, value, errors)
        assert (code == 0) == hub.is_dir()
        told += code == 2
    assert told >= 58


def test_damaged_metadata_of_a_data_set_are_one_line(refused, tmp_path: Path) -> None:
    pytest.importorskip("h5py", reason="needs the extra data")
    data = recorded(tmp_path / "HandOver" / "random-v0")
    metadata = data / "data" / "metadata.json"
    good = metadata.read_text()
    content = json.loads(good)
    content.pop("digest")
    content["bidex"].pop("sealed")
    fits = [("dataset_id", "text"), ("bidex", None)]  # a name, and a data set from elsewhere
    for field in ("total_steps", "total_episodes", "dataset_id", "bidex"):
        for value in METADATA:
            metadata.write_text(json.dumps(content | {field: value}))
            if (field, value) not in fits:
                assert refused("push", data, f"folder:{tmp_path / 'hub'}").count("\n") == 1
    for field in ("tasks", "kind", "versions"):
        for value in (3, ["x", 3], {"packages": []}, {"packages": {"a": 3}}):
            metadata.write_text(json.dumps(content | {"bidex": content["bidex"] | {field: value}}))
            assert refused("push", data, f"folder:{tmp_path / 'hub'}").count("\n") == 1
    metadata.write_text(good[: len(good) // 2])
    assert refused("push", data, f"folder:{tmp_path / 'hub'}").count("\n") == 1
    metadata.write_text(good)
    part = next((data / "data").glob("part*.hdf5"), None) or max((data / "data").glob("*.hdf5"))
    part.write_bytes(part.read_bytes()[:-100])
    assert "is damaged" in refused("push", data, f"folder:{tmp_path / 'hub'}")
    assert not (tmp_path / "hub").exists()


def test_links_are_not_followed_out_of_the_folder(refused, shown, tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text("precious")
    run = Path(shutil.copytree(HAND_OVER, tmp_path / "run"))
    (run / "metrics.jsonl").unlink()
    (run / "metrics.jsonl").symlink_to(secret)
    assert "leads out of it" in refused("push", run, f"folder:{tmp_path / 'hub'}")
    assert "leads out of it" in refused("pull", f"folder:{run}", "--out", tmp_path / "mine")
    (run / "metrics.jsonl").unlink()
    (run / "checkpoints").rename(tmp_path / "elsewhere")
    (run / "checkpoints").symlink_to(tmp_path / "elsewhere")
    assert "leads out of it" in refused("push", run, f"folder:{tmp_path / 'hub'}")
    (run / "checkpoints").unlink()
    (tmp_path / "elsewhere").rename(run / "checkpoints")
    (newest,) = (run / "checkpoints").iterdir()
    (run / "checkpoints" / "last.pt").symlink_to(newest.name)
    shown("push", run, f"folder:{tmp_path / 'hub'}")  # a link within is a copy
    assert not (tmp_path / "hub" / "checkpoints" / "last.pt").is_symlink()
    assert {path.name for path in tmp_path.iterdir()} == {"secret", "run", "hub"}


@pytest.mark.skipif(os.name != "posix", reason="needs a limit of a file's size")
def test_a_pull_that_finds_no_room_or_is_killed_leaves_nothing_in_the_way(refused, shown, tmp_path: Path) -> None:
    out, limits = tmp_path / "mine", resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        assert refused("pull", f"folder:{HAND_OVER}", "--out", out).count("\n") == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(tmp_path.iterdir())
    (tmp_path / ".mine.tmp" / "checkpoints").mkdir(parents=True)  # as a killed one leaves
    (tmp_path / ".mine.tmp" / "config.json").write_text("{")
    shown("pull", f"folder:{HAND_OVER}", "--out", out)
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
    hub = Path(shutil.copytree(HAND_OVER, tmp_path / "hub"))
    (checkpoint,) = (hub / "checkpoints").iterdir()
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    assert "damaged and was deleted" in refused("pull", f"folder:{hub}", "--out", tmp_path / "other")
    assert not (tmp_path / "other").exists() and not list(tmp_path.glob(".*"))


def test_a_hub_that_cannot_be_reached_is_one_line(refused, monkeypatch) -> None:
    hub = pytest.importorskip("huggingface_hub", reason="needs the extra hub")

    class ConnectError(Exception):
        """As of the library's transport, which knows no OSError."""

    def offline(*_: object, **__: object) -> None:
        raise ConnectError("[Errno -2] Name or service not known")

    for name in ("create_repo", "snapshot_download"):
        monkeypatch.setattr(hub, name, offline)
    for words in (("push", HAND_OVER, "me/hand-over"), ("pull", "me/hand-over")):
        said = refused(*words)
        assert said.count("\n") == 1 and "ConnectError, [Errno -2] Name or service" in said and "the network" in said


def test_an_own_suite_goes_along_and_no_path_of_this_machine(shown, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    run = Path(shutil.copytree(MT20, tmp_path / "run"))
    suite = Path(shutil.copyfile(ROOT / "suites" / "MT20.toml", tmp_path / "mine.toml"))
    config = json.loads((run / "config.json").read_text())
    config |= {"suite": str(suite), "teacher": ["scripts", str(tmp_path / "teacher")]}
    (run / "config.json").write_text(json.dumps(config))
    evaluation = json.loads((run / "evaluation.json").read_text())
    (run / "evaluation.json").write_text(json.dumps(evaluation | {"run": str(run)}))
    shown("push", run, "folder:hub")
    texts = [path.read_text() for path in (tmp_path / "hub").iterdir() if path.is_file()]
    assert len(texts) >= 5 and not any(str(tmp_path) in text for text in texts)
    out = tmp_path / "there" / "policy"
    shown("pull", "folder:hub", "--out", out)
    found = RunFolder.open(out).config()
    assert (found.suite, found.teacher) == (str(out / "mine.toml"), ("scripts", "teacher"))
    assert (out / "mine.toml").read_text() == suite.read_text()


def recorded(data: Path) -> Path:
    words = ["--task", "HandOver", "--size", "80", "--num-envs", "2", "--threads", "1", "--device", "cpu"]
    assert main(["record", "random", *words, "--out", str(data)]) == 0
    return data


def test_what_is_no_run_is_refused(refused, tmp_path: Path) -> None:
    assert "has no config.json" in refused("push", tmp_path, f"folder:{tmp_path / 'hub'}")
    assert "holds neither a run's config.json nor a data set" in refused("pull", f"folder:{tmp_path}")

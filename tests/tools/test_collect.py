"""Runs in a file of JSON: tables and pictures take them like folders; what is refused; the best known."""

import json
from pathlib import Path
from typing import Any

import pytest

from bidex_meta.cli import main
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.comparison import read_groups
from bidex_meta.runs import RunFolder
from bidex_meta.runs.stored import open_runs, read_study, study_text
from tests.fakes import change, evaluated_run, log
from tools import collect as tool
from tools import experts
from tools.pages.pretrained import pretrained_table

COMMIT = "0123456789abcdef0123456789abcdef01234567"


def evaluated(root: Path, seed: int, success: float, name: str | None = None, rows: int = 500, **learner) -> Path:
    """A run of two classes with a curve, as the commands leave it; without weights."""
    path = evaluated_run(root, seed, {"A": success, "B": 0.25}, **learner)
    usual = {"time": 1.0, "Train/return/B": 1.0}
    steps = range(1, rows + 1)
    log(path, *({**usual, "step": 2 * i, "Train/success/A": i / rows, "Perf/training_time": 3.0 * i} for i in steps))
    change(path, steps=2 * rows)
    (path / "versions.json").write_text(json.dumps({"git": {"commit": COMMIT, "dirty": False}}))
    return path if name is None else path.rename(root / name)


@pytest.fixture(autouse=True)
def no_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tool, "_parameters", lambda folder: 12345)


def collect(*runs: Path, into: Path, arm: str | None = None) -> None:
    tool.collect(runs, into, arm=arm)


def test_tables_of_files_are_those_of_the_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [evaluated(tmp_path, seed, 0.5 + seed / 7, f"MT4-arm-x-seed{seed}", gamma=0.9) for seed in (0, 1)]
    collect(*paths, into=tmp_path / "data.json")
    files = capsys.readouterr().out.split()
    assert files == [f"{tmp_path / 'data.json'}:MT4-arm-x-seed{seed}" for seed in (0, 1)]
    found = []
    for names in (map(str, paths), files, [str(tmp_path / "data.json")]):
        assert main(["compare", *names, "--json"]) == 0
        found.append(json.loads(capsys.readouterr().out))
    (folder,), (stored,), (whole,) = found
    assert whole == stored
    assert stored["success_iqm"]["value"] == pytest.approx(folder["success_iqm"]["value"], rel=1e-4)
    assert stored["hours"] == folder["hours"] > 0 and stored["seeds"] == [0, 1] and stored["steps"] == 1000
    assert main(["compare", str(paths[0]), files[1]]) == 0, "folders and files beside each other"
    assert main(["plot", *files, "--out", str(tmp_path / "c.png")]) == 0
    assert main(["report", *files, "--out", str(tmp_path / "r.html")]) == 0
    assert COMMIT[:10] in (tmp_path / "r.html").read_text()


def test_groups_have_the_names_of_their_arms(tmp_path: Path) -> None:
    for number, (gamma, arm) in enumerate(
        [(0.9, "usual"), (0.9, "usual"), (0.8, "short"), (0.7, "same"), (0.6, "same")]
    ):
        collect(evaluated(tmp_path, number, 0.5, f"r{number}", gamma=gamma), into=tmp_path / "data.json", arm=arm)
    stored = read_study(tmp_path / "data.json")
    expected = [
        "usual",
        "short",
        "mtppo, gamma 0.7",
        "mtppo, gamma 0.6",
    ]  # an arm's name that two groups have says nothing
    assert [group.label for group in read_groups(stored)] == expected


def test_what_is_refused_leaves_nothing_written(tmp_path: Path) -> None:
    good, into = evaluated(tmp_path, 0, 0.5, "good"), tmp_path / "data.json"
    bad = evaluated(tmp_path, 1, 0.5, "bad")

    def refused(told: str) -> None:
        with pytest.raises(BidexError, match=told):
            collect(good, bad, into=into)
        assert not into.exists()

    evaluation = (bad / "evaluation.json").read_text()
    (bad / "evaluation.json").write_text(json.dumps({"steps": 500, **json.loads(evaluation)}))
    refused("is evaluated at 500 steps, but goes on to 1,000")
    (bad / "evaluation.json").write_text(json.dumps({"policy": {"classes": {"A": {"success": 1, "return": 1, "score": None}}}}))  # fmt: skip  # noqa: E501
    refused("is of another run: it lacks B")
    (bad / "evaluation.json").unlink()
    refused("no evaluation.json")
    (bad / "evaluation.json").write_text(evaluation)
    (bad / "versions.json").write_text('{"git": null}')
    refused("names no commit")
    (bad / "versions.json").write_text(json.dumps({"git": {"commit": COMMIT}}))
    (bad / "metrics.jsonl").write_text("")
    refused("is empty")
    collect(good, into=into)
    collect(good, into=into)  # once more is no harm
    change(good, seed=5)
    with pytest.raises(BidexError, match="is another run than"):
        collect(good, into=into)


@pytest.mark.parametrize("entries", [{"suite": "MT20"}, {"num_envs": 16}, {"touch": True}, {"dataset": ("A/b-v0",)}])
def test_a_run_with_other_settings_does_not_replace_a_stored_run(tmp_path: Path, entries: dict[str, Any]) -> None:
    run, into = evaluated(tmp_path, 0, 0.5, "run"), tmp_path / "data.json"
    collect(run, into=into)
    collect(change(run, threads=3, minutes=60.0), into=into)
    assert read_study(into)[0].config().threads == 3
    before = into.read_text()
    with pytest.raises(BidexError, match=rf"is another run than .* \({next(iter(entries))} differ\)"):
        collect(change(run, **entries), into=into)
    assert into.read_text() == before


@pytest.mark.parametrize(
    ("entries", "told"),
    [
        ({"randomisation": {"joint_noise": 0.1}}, "without randomisation, got one with --randomisation"),
        ({"split": "test"}, "of train tasks, got test tasks"),
    ],
)
def test_only_evaluations_on_train_tasks_without_randomisation_are_shown(
    tmp_path: Path, entries: dict[str, Any], told: str
) -> None:
    path = evaluated(tmp_path / "results", 0, 0.5, "run")
    evaluation = json.loads((path / "evaluation.json").read_text())
    (path / "evaluation.json").write_text(json.dumps({**evaluation, **entries}))
    with pytest.raises(BidexError, match=told):
        collect(path, into=tmp_path / "data.json")
    with pytest.raises(BidexError, match=told):
        experts.best_known(["A"], [path])
    with pytest.raises(BidexError, match=told):
        list(pretrained_table("policies", tmp_path / "results" / "data"))


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    content = tool.condensed(RunFolder.open(evaluated(tmp_path, 0, 0.5, "good")), "x", 7)
    for other, told in (
        ({"format": 2}, "good: .*format: "),
        ({"name": "other"}, "expected the name good, got"),
        ({"curves": {"step": [1, 2], "a": [1.0]}}, "curves.a: expected 2 values"),
        ({"curves": {"step": [2, 1]}}, "expected rising"),
        ({"evaluation": {"policy": {"classes": {}}}}, "policy.classes: "),
        ({"config": {"seed": 0}}, "config: "),
        ({"versions": {"git": 3}}, "git: "),
    ):
        path.write_text(json.dumps({"good": {**content, **other}}))
        with pytest.raises(BidexError, match=told):
            read_study(path)
    for text, told in (
        (study_text({"good": content})[:-40], "in JSON"),
        ("{}", "runs by name"),
        ("[]", "runs by name"),
    ):
        path.write_text(text)
        with pytest.raises(BidexError, match=told):
            open_runs(path)
    path.write_text(study_text({"good": content}))
    with pytest.raises(BidexError, match=r"Unknown run of .*x\.json 'bad'"):
        open_runs(Path(f"{path}:bad"))
    [group] = read_groups(open_runs(Path(f"{path}:good")))
    assert group.paths == [Path(f"{path}:good")]


def test_the_expert_is_the_best_that_solves_half_of_the_tasks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = {
        "script": {"HandOver": {"return": 39.0, "success": 0.5}, "TwoCatchUnderarm": {"return": 7.0, "success": 0.49}},
        "witness": {"HandOver": {"return": 40.0, "success": 0.2}, "CatchUnderarm": {"return": 5.0, "success": 0.9}},
    }
    monkeypatch.setattr(experts, "load", known.__getitem__)
    out, suite = tmp_path / "o", evaluated_run(tmp_path, 3, {"HandOver": 0.4, "CatchAbreast": 0.6})
    out.write_text('{"classes": {"Switch": {"return": 1.0}}}')  # is not kept
    experts.experts((suite, evaluated_run(tmp_path, 3, {"CatchAbreast": 0.5}, task="CatchAbreast")), "MT4", out)
    found = json.loads(out.read_text())["classes"]
    assert {name: (row["return"], row["source"]) for name, row in found.items()} == {
        "HandOver": (39.0, "script"),
        "CatchAbreast": (6.0, "mtppo on MT4, 1,000 steps, seed 3"),
        "CatchUnderarm": (5.0, "witness"),
    }


def test_runs_of_version_2_are_no_experts_of_version_1(tmp_path: Path) -> None:
    path = change(evaluated_run(tmp_path, 0, {"Switch": 1.0}), suite="MT20-v2")
    with pytest.raises(BidexError, match=r"rules of version 1, but .* plays MT20-v2 by other rules"):
        experts.best_known(["Switch"], [path])

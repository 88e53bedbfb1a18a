"""Runs as files of JSON: what they keep, that tables and pictures take them like folders, and what is refused."""

import json
from pathlib import Path

import pytest

from bidex_meta.cli import main
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.comparison import read_groups
from bidex_meta.runs import RunFolder
from bidex_meta.runs.stored import StoredRun, open_run
from tests.fakes import change, evaluated_run, log
from tools import collect as tool

COMMIT = "0123456789abcdef0123456789abcdef01234567"


def evaluated(root: Path, seed: int, success: float, name: str | None = None, rows: int = 500, **learner) -> Path:
    """A run of two classes with a curve, as the commands leave it; without weights."""
    path = evaluated_run(root, seed, {"A": success, "B": 0.25}, **learner)
    lines = [
        {"step": 2 * i, "time": 1.0, "Train/success/A": i / rows, "Train/return/B": 1.0, "Perf/training_time": 3.0 * i}
        for i in range(1, rows + 1)
    ]
    log(path, *lines)
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
    collect(*paths, into=tmp_path / "data")
    files = capsys.readouterr().out.split()
    assert files == [str(tmp_path / "data" / f"MT4-arm-x-seed{seed}.json") for seed in (0, 1)]
    found = []
    for names in (map(str, paths), files):
        assert main(["compare", *names, "--json"]) == 0
        found.append(json.loads(capsys.readouterr().out))
    (folder,), (stored,) = found
    assert stored["success_iqm"]["value"] == pytest.approx(folder["success_iqm"]["value"], rel=1e-4)
    assert stored["hours"] == folder["hours"] > 0 and stored["seeds"] == [0, 1] and stored["steps"] == 1000
    assert main(["compare", str(paths[0]), files[1]]) == 0, "folders and files beside each other"
    assert main(["plot", *files, "--out", str(tmp_path / "c.png")]) == 0
    assert main(["report", *files, "--out", str(tmp_path / "r.html")]) == 0
    assert COMMIT[:10] in (tmp_path / "r.html").read_text()


def test_a_run_that_a_return_ended_is_kept_as_it_ended(tmp_path: Path) -> None:
    path = evaluated(tmp_path, 0, 0.5)
    folder = log(path, *({"step": 2 * i, "Train/mean_return": i / 50, "Train/return/A": 1.0} for i in range(1, 501)))
    found = json.loads((path / "evaluation.json").read_text())
    (path / "evaluation.json").write_text(json.dumps({"steps": 1000, **found}))
    change(folder.path, steps=10**9, stop_at_return=10.0)
    collect(path, into=tmp_path / "data")
    stored = StoredRun.open(tmp_path / "data" / f"{path.name}.json")
    [group] = read_groups([stored])
    assert (stored.content["steps"], stored.goal, group.steps) == (1000, 1000, 1000)
    change(folder.path, stop_at_return=10.5)
    with pytest.raises(BidexError, match="evaluated at 1,000 steps"):
        collect(path, into=tmp_path / "data")


def test_what_is_refused_leaves_nothing_written(tmp_path: Path) -> None:
    good, into = evaluated(tmp_path, 0, 0.5, "good"), tmp_path / "data"
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
    refused("holds nothing")
    (bad / "config.json").write_text("{}")
    refused("config.json: ")
    collect(good, into=into)
    collect(good, into=into)  # once more is no harm
    folder = RunFolder.open(good)
    change(folder.path, seed=5)
    with pytest.raises(BidexError, match="is of another run than"):
        collect(good, into=into)


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    content = tool.condensed(RunFolder.open(evaluated(tmp_path, 0, 0.5)), "x", 7)
    for other, told in (
        ({"format": 2}, "format: "),
        ({"curves": {"step": [1, 2], "a": [1.0]}}, "curves.a: expected 2 values"),
        ({"curves": {"step": [2, 1]}}, "expected rising"),
        ({"evaluation": {"policy": {"classes": {}}}}, "policy.classes: "),
        ({"config": {"seed": 0}}, "config: "),
        ({"versions": {"git": 3}}, "git: "),
    ):
        path.write_text(json.dumps({**content, **other}))
        with pytest.raises(BidexError, match=told):
            StoredRun.open(path)
    path.write_text(tool.text(content)[:-40])
    with pytest.raises(BidexError, match="in JSON"):
        open_run(path)
    path.write_text(tool.text(content))
    [group] = read_groups([StoredRun.open(path)])
    assert group.paths == [path]

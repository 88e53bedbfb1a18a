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
from tests.pages import ROOT
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


def test_what_a_file_keeps(tmp_path: Path) -> None:
    folder = RunFolder.open(evaluated(tmp_path, 0, 1 / 3))
    content = tool.condensed(folder, "x", 7)
    curves = content["curves"]
    assert len(curves["step"]) == 60 and curves["step"][-1] == 1000 == content["steps"]
    assert curves["Perf/training_time"][-1] == 1500.0 == content["seconds"]
    # Each point is the mean of the stretch that ends with it.
    first = curves["step"][0] // 2
    assert curves["Train/success/A"][0] == pytest.approx((first + 1) / 2 / 500, rel=1e-3)
    assert content["evaluation"]["policy"]["classes"]["A"]["success"] == 0.33333
    assert (content["suite"], content["parameters"]) == ({"name": "MT4", "version": 1}, 7)
    assert content["engine"] == "c"
    path = tmp_path / "x.json"
    path.write_text(tool.text(content))
    assert json.loads(path.read_text()) == content
    assert open_run(path).metrics()[-1] == {"step": 1000, **{t: c[-1] for t, c in curves.items() if t != "step"}}


def test_no_folder_of_this_machine_stays(tmp_path: Path) -> None:
    path, suite = evaluated(tmp_path, 0, 0.5), tmp_path / "own.toml"
    suite.write_text((ROOT / "suites" / "MT4.toml").read_text().replace('"MT4"', '"own"'))
    folder = RunFolder.open(path)
    change(folder.path, suite=str(suite), start_from=str(tmp_path / "other"))
    found = json.loads((path / "evaluation.json").read_text())
    (path / "evaluation.json").write_text(json.dumps({"run": str(path), **found}))
    content = tool.condensed(folder, "x", None)
    assert str(tmp_path) not in json.dumps(content)
    assert content["suite"]["name"] == "own" and "CatchUnderarm" in content["suite"]["file"]
    assert content["config"]["suite"] == "own.toml"
    change(folder.path, suite=None, task="HandOver", object=str(tmp_path / "mug.xml"))
    content = tool.condensed(folder, "x", None)
    assert str(tmp_path) not in json.dumps(content) and content["config"]["object"] == "mug.xml"


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


def test_a_run_of_changed_code_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clean, changed = (evaluated(tmp_path, seed, 0.5, f"run{seed}") for seed in (0, 1))
    (changed / "versions.json").write_text(json.dumps({"git": {"commit": COMMIT, "dirty": True}}))
    collect(clean, changed, into=tmp_path / "data")
    told = capsys.readouterr()
    assert (
        told.err
        == f"{tmp_path / 'data' / 'run1.json'} was made by changed code: its commit alone does not make it again.\n"
    )
    assert len(told.out.split()) == 2


@pytest.mark.parametrize(
    "name, arm",
    [("MT4-soft modules-seed0", "soft modules"), ("mt4_gamma_s12", "gamma"), ("2026-11-21_10-00-00_seed0", "mtppo"),
     ("MT4", "mtppo"), ("again", "again")],
)  # fmt: skip
def test_an_arm_is_the_name_without_suite_and_seed(name: str, arm: str) -> None:
    assert tool.arm_of(Path("runs") / name, {"suite": "MT4", "task": None, "algo": "mtppo"}) == arm


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


def test_a_meta_test_of_test_tasks_alone_need_not_show_what_was_trained(tmp_path: Path) -> None:
    run = evaluated(tmp_path, 0, 0.5)
    rows = {"classes": {"C": {"success": 1.0, "return": 1.0, "score": None}}}
    of_test = {"before": rows, "after": rows}
    (run / "evaluation.json").write_text(json.dumps({"splits": {"test": of_test}}))
    assert tool.condensed(RunFolder.open(run), "x", 7)["evaluation"]["splits"].keys() == {"test"}
    (run / "evaluation.json").write_text(json.dumps({"splits": {"train": of_test, "test": of_test}}))
    with pytest.raises(BidexError, match="of another run"):
        tool.condensed(RunFolder.open(run), "x", 7)


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

"""The leaderboard: its statistics on known numbers, its files, and a submission that is played."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bidex_meta.errors import BidexError
from bidex_meta.evaluation import leaderboard, statistics
from bidex_meta.evaluation.leaderboard import check_apart, improvement, profile, read_entry, success_iqm
from bidex_meta.runs import RunFolder
from bidex_meta.runs.checkpoints import weights_digest
from tests.cli.conftest import SMALL
from tests.pages import ROOT
from tools.pages.leaderboard import leaderboard_table

SHIPPED = sorted((ROOT / "results" / "leaderboard").glob("*.json"))


def classes(*rates: float, tasks: int = 10) -> list[np.ndarray]:
    """One seed that solves these shares of its tasks."""
    return [np.array([[1.0] * round(rate * tasks) + [0.0] * (tasks - round(rate * tasks))]) for rate in rates]


def test_measures_of_known_numbers() -> None:
    a, b = classes(0.0, 0.2, 0.6, 1.0), classes(0.1, 0.2, 0.5, 0.9)
    assert success_iqm(a).value == pytest.approx(0.4)
    assert [profile(a, rate) for rate in (0.1, 0.6, 0.9)] == [0.75, 0.25, 0.25]
    assert improvement(a, b).value == pytest.approx((0.0 + 0.5 + 1.0 + 1.0) / 4)
    assert improvement(a, b).value + improvement(b, a).value == pytest.approx(1.0)
    two = [np.concatenate(pair) for pair in zip(a, b, strict=True)]
    assert improvement(two, two).value == pytest.approx(0.5)
    assert success_iqm(two).value == pytest.approx((0.1 + 0.2 + 0.2 + 0.5 + 0.6 + 0.9 - 0.1 - 0.9) / 4)


def test_an_interval_of_a_single_value_is_none() -> None:
    assert success_iqm(classes(1.0, tasks=1)).interval is None


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_entries_fit(path: Path) -> None:
    entry = read_entry(path)
    for row in (*entry.own.values(), *entry.others.values()):
        assert row.success == pytest.approx(np.mean(row.tasks), abs=1e-3)
    assert path.name.startswith(f"{entry.suite}-")


def test_digests_of_shipped_policies_are_those_of_their_entries() -> None:
    """Both policies are stored in half precision, the runs had single precision."""
    for file, run in (("MT20-dagger", "assets/policies/MT20"), ("MT20-mtppo", "results/MT20-mtppo-seed0")):
        loaded = RunFolder.open(ROOT / run).checkpoints.load()
        assert loaded is not None
        digest = weights_digest(loaded[0]["learner"]["policy"])
        assert digest == read_entry(ROOT / "results" / "leaderboard" / f"{file}.json").weights[0]
        policy = {"weights": {name: w.float() for name, w in loaded[0]["learner"]["policy"]["weights"].items()}}
        assert weights_digest(policy) == digest


def _nudged(entry: dict[str, Any], *place: Any) -> Any:
    for name in place:
        entry = entry[name]
    return entry


# Each changes one thing of an entry, whose first class is HandOver.
EDITS: dict[str, Callable[[dict[str, Any]], object]] = {
    "more success": lambda e: e["own"]["HandOver"].update(success=1.0),
    "more success, its interval too": lambda e: e["own"]["HandOver"].update(success=1.0, interval=[1.0, 1.0]),
    "a rate above 1": lambda e: e["own"]["HandOver"].update(success=1.01),
    "a task that is solved by half": lambda e: _nudged(e, "own", "HandOver", "tasks", 0).__setitem__(0, 0.5),
    "a task more": lambda e: _nudged(e, "own", "HandOver", "tasks", 0).append(1.0),
    "a task less": lambda e: _nudged(e, "others", "HandOver", "tasks", 0).pop(),
    "other tasks": lambda e: e["own"]["HandOver"].update(tasks=[[1.0] * 50]),
    "an interval elsewhere": lambda e: e["own"]["HandOver"].update(interval=[0.0, 0.1]),
    "a narrow interval": lambda e: e["own"]["HandOver"].update(interval=[e["own"]["HandOver"]["success"]] * 2),
    "no interval": lambda e: e["own"]["HandOver"].update(interval=None),
    "a text as a rate": lambda e: e["own"]["HandOver"].update(success="1"),
    "a class left out": lambda e: (e["own"].pop("PourWater"), e["others"].pop("PourWater")),
    "a class left out of the others": lambda e: e["others"].pop("PourWater"),
    "a class of another name": lambda e: e["own"].update(Juggling=e["own"].pop("PourWater")),
    "two classes in each other's place": lambda e: _swap(e["own"]),
    "a seed twice": lambda e: e["stated"].update(seeds=[0, 0]),
    "a seed more": lambda e: e["stated"].update(seeds=[0, 1]),
    "a run counted twice": lambda e: _twice(e),
    "another digest's form": lambda e: e.update(weights=["0123"]),
    "negative hours": lambda e: e["stated"].update(hours=[-1.0]),
    "hours of more runs": lambda e: e["stated"].update(hours=[0.1, 0.1]),
    "a commit that is none": lambda e: e["stated"].update(commit=["main"]),
    "a device with markup": lambda e: e["stated"].update(device="H100 | **best**"),
    "no steps": lambda e: e.update(steps=[0]),
    "a fraction of an episode": lambda e: e.update(episodes=0.5),
    "more episodes than were played": lambda e: e.update(episodes=0),
    "another version": lambda e: e.update(version=2),
    "another suite": lambda e: e.update(suite="MT4"),
    "another name": lambda e: e.update(name="best"),
    "an entry of one's own": lambda e: e.update(stars=5),
    "hours as if they were verified": lambda e: e["verified"].update(hours=[0.284]),
    "physics that are no digest": lambda e: e["verified"].update(physics="real"),
    "no version of MuJoCo": lambda e: e["verified"]["packages"].pop("mujoco"),
    "a number as a version": lambda e: e["verified"]["packages"].update(mujoco=4),
    "a path of a machine": lambda e: e["verified"].update(device="/home/me/gpu"),
    "an older format": lambda e: e.update(format=1),
}


def _swap(classes: dict[str, Any]) -> None:
    classes["HandOver"], classes["PourWater"] = classes.pop("PourWater"), classes.pop("HandOver")


def _twice(entry: dict[str, Any]) -> None:
    """One run as two seeds, in every list."""
    entry["weights"] *= 2
    entry["steps"] *= 2
    entry["stated"] |= {"seeds": [0, 1], "hours": entry["stated"]["hours"] * 2, "commit": entry["stated"]["commit"] * 2}
    for row in (*entry["own"].values(), *entry["others"].values()):
        row["tasks"] *= 2


@pytest.mark.parametrize("edit", EDITS)
def test_an_edited_entry_is_refused(edit: str, tmp_path: Path) -> None:
    path = tmp_path / "MT20-mtppo.json"
    content = json.loads((ROOT / "results" / "leaderboard" / path.name).read_text())
    path.write_text(json.dumps(content))
    read_entry(path)
    EDITS[edit](content)
    path.write_text(json.dumps(content))
    with pytest.raises(BidexError) as told:
        read_entry(path)
    assert "\n" not in str(told.value) and str(path) in str(told.value)


def test_a_policy_stands_in_one_entry_alone() -> None:
    entries = {path: read_entry(path) for path in SHIPPED}
    check_apart(entries)
    first = next(iter(entries.values()))
    with pytest.raises(BidexError, match="their weights are equal"):
        check_apart(entries | {Path("copy.json"): first})


def test_a_submission_is_played_and_ranked(toy_worlds, tmp_path: Path, shown, refused, monkeypatch) -> None:
    monkeypatch.setattr(statistics, "RESAMPLES", 400)
    monkeypatch.setattr(leaderboard, "tasks_of_suite", lambda name, version: {"Near": 3, "Far": 2})
    runs = [str(tmp_path / f"r{seed}") for seed in (0, 1)]
    for seed, run in enumerate(runs):
        shown("run", *SMALL, "--steps", "96", "--run-dir", run, "--seed", seed, "--no-evaluate")
    out = tmp_path / "leaderboard"
    copy = shutil.copytree(runs[0], tmp_path / "copy")
    config = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps(config | {"seed": 2}))
    assert "they are one run" in refused("submit", *runs, copy, "--out", out)
    shown("submit", *runs, "--out", out, "--episodes", "2", "--device", "cpu")
    entry = read_entry(out / "MT4-mtppo.json")
    assert (entry.suite, entry.version, entry.stated.seeds, entry.steps) == ("MT4", 1, [0, 1], [96, 96])
    assert list(entry.own) == ["Near", "Far"] and entry.stated.device == "cpu, 1 thread"
    assert len({*entry.weights}) == 2
    lines = list(leaderboard_table("MT4", tmp_path / "data"))
    assert (
        len(lines) == 3 and lines[2].startswith("| 1 | mtppo | ") and not list(leaderboard_table("MT1", tmp_path / "x"))
    )
    assert lines[0].count("stated: ") == 3
    assert "There is" in refused("submit", *runs, "--out", out)
    assert "Two of the runs have one seed" in refused("submit", runs[0], runs[0], "--name", "x", "--out", out)
    assert f"stands in {out / 'MT4-mtppo.json'}" in refused("submit", copy, "--name", "x", "--out", out)


def test_an_entry_of_an_own_suite_holds_no_path(toy_worlds, tmp_path: Path, shown, monkeypatch) -> None:
    monkeypatch.setattr(statistics, "RESAMPLES", 400)
    suite = shutil.copyfile(ROOT / "suites" / "MT4.toml", tmp_path / "mine.toml")
    run, out = tmp_path / "r", tmp_path / "leaderboard"
    shown("run", *SMALL[2:], "--suite", suite, "--steps", "24", "--run-dir", run, "--no-evaluate")
    shown("submit", run, "--out", out, "--device", "cpu")
    assert read_entry(out / "mine-mtppo.json").suite == "mine"
    assert str(tmp_path) not in (out / "mine-mtppo.json").read_text()

"""Own data against others': the arms, their differences, and the command."""

import json

import numpy as np
import pytest

from bidex_meta.cli import main
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.control_arms import arms, control
from bidex_meta.evaluation.eval_protocol import Protocol
from bidex_meta.evaluation.meta_test import meta_evaluate
from bidex_meta.worlds.own import OwnSuite
from tests.cli.conftest import FINDER
from tests.fakes import change
from tests.points import Finder, PointWorld, Still, ring

NORTH, EAST, WEST = np.array([[0.0, 1.0]]), np.array([[1.0, 0.0]]), np.array([[-1.0, 0.0]])
TASKS = OwnSuite.tasks
PLAYED = Protocol(seed=4, rollouts=6, episodes_per_task=5, trials=3)


def world(*goals, rows=18):
    return PointWorld(rows, {"Near": np.concatenate(goals)})


@pytest.mark.parametrize("rows", [18, 6])  # all adaptations at once, and in portions
def test_only_what_adapts_to_the_task_gains_above_others_data(rows):
    said = []
    found = control(Finder, world(NORTH, rows=rows), world(EAST, WEST, rows=rows), say=said.append, protocol=PLAYED)
    assert len(said) == 3 and said[0].startswith("before: Near -")
    assert said[2].startswith("adapted to data of train task 2")
    assert len(found.foreign) == 2 and len(found.own.classes["Near"].returns) == 3 * 5
    by_arm = arms([found], "Near", ["east", "west"])
    assert list(by_arm) == ["before", "own", "foreign", "east", "west"]
    for arm in ("before", "foreign", "east", "west"):
        gain = by_arm[arm]["own_minus"]["return"]
        assert gain.interval[0] > 0 and gain.value == pytest.approx(by_arm["own"]["return"] - by_arm[arm]["return"])
        assert by_arm[arm]["own_minus"]["score"] is None
    assert by_arm["foreign"]["return"] == pytest.approx(np.mean([by_arm[arm]["return"] for arm in ("east", "west")]))


def test_the_arms_are_those_of_the_meta_test():
    found = control(Finder, world(NORTH), world(EAST, WEST), protocol=PLAYED)
    own = meta_evaluate(Finder(), world(NORTH), protocol=PLAYED)
    west = meta_evaluate(Finder(), world(NORTH), protocol=PLAYED, adapt_world=world(WEST))
    for ours, theirs in ((found.before, own.before), (found.own, own.after), (found.foreign[1], west.after)):
        np.testing.assert_array_equal(ours.classes["Near"].returns, theirs.classes["Near"].returns)


def test_what_does_not_adapt_gains_exactly_nothing():
    by_arm = arms([control(Still, world(NORTH), world(EAST, WEST), protocol=PLAYED)], "Near", ["east", "west"])
    for arm in ("before", "foreign", "east", "west"):
        gain = by_arm[arm]["own_minus"]["return"]
        assert (gain.value, gain.interval) == (0.0, (0.0, 0.0))


def test_splits_with_other_classes_are_refused():
    other = PointWorld(6, {"Far": EAST})
    with pytest.raises(BidexError, match="same classes in both splits"):
        control(Finder, world(NORTH, rows=6), other)


@pytest.fixture
def runs(tmp_path, monkeypatch, finder):
    def points(source, split="train", rows=None, mode="DISABLED"):
        goals = ring(1) if split == "test" else ring(3, 1.0)
        return PointWorld(rows or 6, {"CatchUnderarm": goals}, mode=mode)

    monkeypatch.setattr(OwnSuite, "world", points)
    monkeypatch.setattr(OwnSuite, "tasks", TASKS)
    monkeypatch.setattr(PointWorld, "state_dict", dict, raising=False)
    paths = [str(tmp_path / seed) for seed in "01"]
    for path in paths:
        assert main(["run", *FINDER, "--suite", "ML1", "--no-evaluate", "--seed", path[-1], "--run-dir", path]) == 0
    return paths


def test_the_command_shows_all_arms_of_all_runs(runs, shown):
    flags = ["--trials", "3", "--episodes", "4"]
    table = shown("control", *runs, *flags)
    assert "2 runs, 24 episodes an arm" in table
    for label in ("its own data", "train tasks' data, mean", "data of original", "data of left", "data of right"):
        assert label in table
    found = json.loads(shown("control", *runs, *flags, "--json"))
    assert found["episodes"] == {"CatchUnderarm": 24} and len(found["runs"]) == 2
    assert (found["shots"], found["trials"]) == (2, 3) and found["rollouts"] > 0
    by_arm = found["classes"]["CatchUnderarm"]
    assert by_arm["before"]["own_minus"]["return"]["interval"][0] > 0 and len(by_arm["own"]["runs"]) == 2


def test_runs_that_are_no_seeds_of_one_experiment_are_refused(runs, refused):
    for entries, named, expected in (
        ({"steps": 48}, runs, "differ in steps"),
        ({"steps": 24, "start_from": "/runs/1"}, runs, "differ in started"),
        ({"start_from": None, "suite": "MT4"}, runs[1:], "but MT4 shows them"),
        ({"suite": "ML1-Switch-choice2"}, runs[1:], "ML1-Switch-choice2 has the same tasks in both splits"),
        ({"algo": "mtppo"}, runs[1:], "does not adapt"),
        ({}, [], "Name the run folders"),
        ({}, [runs[0], runs[0]], "both have seed 0. Name one run for each seed."),
        ({}, [*runs, "--trials", "0"], "--trials"),
    ):
        change(runs[1], **entries)
        assert expected in refused("control", *named)

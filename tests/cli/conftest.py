"""Worlds of points in the place of hands, and the commands in one line each."""

from collections.abc import Callable
from pathlib import Path

import pytest

from bidex_meta.cli import main
from bidex_meta.experiments import learners
from bidex_meta.worlds.own import OwnSuite
from tests.fakes import ToyWorld
from tests.points import PointWorld, ring

COUNTS = {"train": {"Near": 6, "Far": 6}, "test": {"Near": 2}}
FINDER = ["--suite", "ML4", "--algo", "finder", "--num-envs", "24", "--steps", "24"]
FINDER += ["--threads", "1", "--device", "cpu"]

Command = Callable[..., str]


@pytest.fixture
def shown(capsys: pytest.CaptureFixture[str]) -> Command:
    """Calls a command that succeeds; what it prints."""

    def call(*words: object) -> str:
        capsys.readouterr()
        assert main(list(map(str, words))) == 0
        return capsys.readouterr().out

    return call


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Command:
    """Calls a command that refuses its input; what it says."""

    def call(*words: object) -> str:
        capsys.readouterr()
        assert main(list(map(str, words))) == 2
        return capsys.readouterr().err

    return call


def toy(source, split="train", rows=None, mode="DISABLED"):
    return ToyWorld(rows or 6, mode, source.seed)


@pytest.fixture
def toy_worlds(monkeypatch):
    monkeypatch.setattr(OwnSuite, "world", toy)


def points(source, split="train", rows=None, mode="DISABLED"):
    pools = {name: ring(count, split == "test") for name, count in COUNTS[split].items()}
    place = PointWorld(rows or 12, pools, mode=mode)
    place.state_dict = dict  # type: ignore[attr-defined]
    place.load_state_dict = lambda state: None  # type: ignore[attr-defined]
    return place


@pytest.fixture
def finder(monkeypatch):
    """Suites are points to be found, and ``finder`` is a learner that adapts."""
    monkeypatch.setattr(OwnSuite, "world", points)
    pools = {split: {name: [""] * count for name, count in counts.items()} for split, counts in COUNTS.items()}
    monkeypatch.setattr(OwnSuite, "tasks", lambda source, split: pools[split])
    monkeypatch.setitem(learners.ALGOS, "finder", "tests.adapting_learner:Learner")


@pytest.fixture
def adapted(finder, tmp_path) -> Path:
    """A run of it."""
    path = tmp_path / "r"
    assert main(["run", *FINDER, "--run-dir", str(path)]) == 0
    return path

"""Worlds of points in the place of hands, and the commands in one line each."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from bidex_meta.cli import main
from bidex_meta.evaluation import statistics
from bidex_meta.experiments import learners
from bidex_meta.utils import waiting
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


SMALL = ["--suite", "MT4", "--num-envs", "6", "--threads", "1", "--device", "cpu", "--learner.hidden", "8"]


def toy(source, split="train", rows=None, mode="DISABLED"):
    return ToyWorld(rows or 6, mode, source.seed)


@pytest.fixture
def toy_worlds(monkeypatch):
    monkeypatch.setattr(OwnSuite, "world", toy)


@pytest.fixture(scope="session")
def trained_once(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("toy") / "r"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OwnSuite, "world", toy)
        assert main(["run", *SMALL, "--steps", "96", "--run-dir", str(path), "--episodes", "4"]) == 0
    return path


@pytest.fixture
def run(trained_once, toy_worlds, tmp_path) -> Path:
    """An evaluated run of 96 steps on the small worlds."""
    return shutil.copytree(trained_once, tmp_path / "r")


@pytest.fixture
def noted(monkeypatch) -> list[str]:
    """The activities that a command reports, in order."""
    told: list[str] = []
    monkeypatch.setattr(waiting._Watch, "what", property(lambda self: "x", lambda self, what: told.append(what)), False)
    return told


def points(source, split="train", rows=None, mode="DISABLED"):
    pools = {name: ring(count, split == "test") for name, count in COUNTS[split].items()}
    place = PointWorld(rows or 12, pools, mode=mode)
    place.state_dict = dict  # type: ignore[attr-defined]
    place.load_state_dict = lambda state: None  # type: ignore[attr-defined]
    return place


def find_points(patch: pytest.MonkeyPatch) -> None:
    """Suites are points to be found, and ``finder`` is a learner that adapts."""
    patch.setattr(OwnSuite, "world", points)
    pools = {split: {name: [""] * count for name, count in counts.items()} for split, counts in COUNTS.items()}
    patch.setattr(OwnSuite, "tasks", lambda source, split: pools[split])
    patch.setitem(learners.ALGOS, "finder", "tests.adapting_learner:Learner")


@pytest.fixture
def finder(monkeypatch):
    find_points(monkeypatch)


@pytest.fixture(scope="session")
def adapted_once(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("finder") / "r"
    with pytest.MonkeyPatch.context() as patch:
        find_points(patch)
        assert main(["run", *FINDER, "--run-dir", str(path)]) == 0
    return path


@pytest.fixture
def adapted(adapted_once, finder, tmp_path) -> Path:
    """An evaluated run of ``finder``."""
    return shutil.copytree(adapted_once, tmp_path / "r")


@pytest.fixture
def few_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statistics, "RESAMPLES", 100)

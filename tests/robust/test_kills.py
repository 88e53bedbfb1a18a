"""Runs that are killed again and again end as the unbroken ones do: files, weights, worlds, metrics, bit for bit."""

import random
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

if sys.platform != "linux":
    pytest.skip("forks, and reads /proc", allow_module_level=True)

from bidex_meta.experiments.learners import ALGOS
from tests.robust.kills import KILLED, Victim, outcome, quick_folder, server, unequal
from tests.robust.victims import FLAGS, OFFLINE, TAUGHT, arguments

ITERATIONS = 12
pytestmark = pytest.mark.xdist_group("kills")  # one server for all


@pytest.fixture(scope="module")
def place() -> Iterator[Path]:
    with quick_folder() as folder:
        yield folder


@pytest.fixture(scope="module")
def killer() -> Iterator[subprocess.Popen[str]]:
    with server() as process:
        yield process


def killed_often(
    algo: str, seed: int, killer: subprocess.Popen[str], place: Path, record: bool = False
) -> dict[str, object]:
    """The unbroken run's outcome, which the killed one's equals."""
    draw, given = random.Random(f"{algo} {seed}"), None
    if algo in OFFLINE + TAUGHT:
        pytest.importorskip("h5py")
        recorded = run_that_recorded(killer, place)
        given = recorded / "replay" if algo in OFFLINE else recorded
    often = draw.random() < 0.5 or record  # each checkpoint begins another part of what is recorded
    whole = Victim(
        killer, arguments(algo, ITERATIONS, record=record, given=given), place / f"{algo}{seed}whole{record}"
    )
    answer = whole.go_on()
    assert answer["code"] == 0, whole.log.read_text()
    run = Victim(killer, whole.arguments, place / f"{algo}{seed}{record}", 0.0 if often else 0.02)
    run.kill_often(whole.counts(), answer["cpu"], draw)
    print(f"kills: {algo} {dict(run.fell)}")
    expected = outcome(whole.path, often)
    assert unequal(outcome(run.path, often), expected) == []
    return expected


def run_that_recorded(killer: subprocess.Popen[str], place: Path) -> Path:
    """A run whose policy teaches others, and whose data set they learn from."""
    run = Victim(killer, arguments("mtppo", ITERATIONS, record=True), place / "stored")
    if not run.path.exists():
        assert run.go_on()["code"] == 0, run.log.read_text()
    return run.path


def test_every_learner_can_be_killed() -> None:
    assert FLAGS.keys() == ALGOS.keys()


QUICK = [(algo, 0) for algo in ("mtsac", "rl2", "iql")]
SLOW = [pytest.param(algo, seed, marks=pytest.mark.slow) for seed in (1, 2) for algo in FLAGS]


@pytest.mark.parametrize(("algo", "seed"), QUICK + SLOW)
def test_killed_runs_end_as_unbroken_ones(algo: str, seed: int, killer: subprocess.Popen[str], place: Path) -> None:
    killed_often(algo, seed, killer, place)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("algo", ["mtppo", "mtsac", "promp", "rl2"])
def test_killed_runs_that_record(algo: str, seed: int, killer: subprocess.Popen[str], place: Path) -> None:
    pytest.importorskip("h5py")
    assert killed_often(algo, seed, killer, place, record=True)["recorded"]


@pytest.mark.parametrize("stride", [30, pytest.param(1, marks=pytest.mark.slow)])
def test_killed_before_operations_on_files(stride: int, killer: subprocess.Popen[str], place: Path) -> None:
    """Runs of four iterations, each killed before another operation on a file of its folder."""
    whole = Victim(killer, arguments("mtppo", 4), place / f"{stride}whole")
    assert whole.go_on()["code"] == 0
    expected, operations = outcome(whole.path), whole.counts()["operations"]
    wrong = {}
    for number in range(1, operations + 1, stride):
        run = Victim(killer, whole.arguments, place / f"{stride}at{number}")
        assert run.go_on(aim=("operations", number))["code"] == KILLED
        assert run.go_on()["code"] == 0, (number, run.log.read_text())
        wrong[number] = unequal(outcome(run.path), expected)
    print(f"kills: {len(wrong)} of {operations} operations")
    assert not any(wrong.values()), wrong

"""Runs of two processes by torchrun: one is killed, or both with torchrun; resumed, they end as unbroken ones."""

import json
import os
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

if sys.platform != "linux":
    pytest.skip("asks ps", allow_module_level=True)

from tests.robust.kills import ROOT, environment, outcome, quick_folder, unequal
from tests.robust.marks import read
from tests.robust.victims import arguments
from tests.test_several_processes import workers

ITERATIONS = 10
AIMS = ((0, "saving"), (1, "training"), (0, "watching"), (None, "saving"), (0, "evaluating"))
"""Who dies where; None: both processes and torchrun, as a machine does."""


class Pair:
    """A run of two processes.

    Args:
        algo: Its learner.
        path: Its folder.
    """

    def __init__(self, algo: str, path: Path):
        # Steps count over the rows of both.
        self.words, self.path = arguments(algo, ITERATIONS, processes=2), path

    def marks(self, rank: int) -> Path:
        return self.path.with_name(f"{self.path.name}.marks{rank}")

    def go_on(self, rank: int | None = 0, aim: tuple[str, int] | None = None) -> tuple[int, str]:
        """Begins the run, or goes on with it; exit code of torchrun, and what was said."""
        begun = (self.path / "config.json").exists()
        words = ["run", "--resume", str(self.path), "--episodes", "1"] if begun else self.words
        words = words if begun else [*words, "--run-dir", str(self.path)]
        jobs = [{"arguments": words, "folder": str(self.path), "marks": str(self.marks(i))} for i in range(2)]
        jobs[rank or 0]["aim"] = aim  # type: ignore[assignment]
        jobs[rank or 0]["together"] = rank is None  # type: ignore[assignment]
        line = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
        line += ["-m", "tests.robust.victims", json.dumps(jobs)]
        with subprocess.Popen(
            line, cwd=ROOT, env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        ) as process:
            if rank is None and aim is not None:
                self._kill_all(process)
            _, said = process.communicate(timeout=500)
        return process.returncode, said

    def _kill_all(self, process: subprocess.Popen[str]) -> None:
        """Waits until the aimed process has stopped itself, then ends all by SIGKILL."""
        while process.poll() is None:
            for pid in (own := workers(process)).values():
                if _stopped(pid):
                    for each in (process.pid, *own.values()):
                        os.kill(each, signal.SIGKILL)
                    return


def _stopped(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"
    except FileNotFoundError:
        return False


@pytest.fixture(scope="module")
def place() -> Iterator[Path]:
    with quick_folder() as folder:
        yield folder


@pytest.mark.slow
@pytest.mark.parametrize("algo", ["mtppo", "mtsac", "happo", "rl2"])
def test_two_processes_are_killed_and_resume(algo: str, place: Path) -> None:
    whole, run, draw = Pair(algo, place / f"{algo}whole"), Pair(algo, place / algo), random.Random(algo)
    code, said = whole.go_on()
    assert code == 0, said
    counts, fell = [read(whole.marks(rank))[1] for rank in range(2)], []
    for rank, phase in AIMS:
        most = counts[rank or 0][phase]
        number = draw.randint(1, most if phase == "evaluating" else max(1, most // 5))
        code, said = run.go_on(rank, (phase, number))
        assert code != 0, (rank, phase, number, said)
        fell.append(f"{'both' if rank is None else rank} {read(run.marks(rank or 0))[0]}")
    code, said = run.go_on()
    assert code == 0, said
    print(f"kills: {algo} {fell}")
    assert unequal(outcome(run.path), outcome(whole.path)) == []

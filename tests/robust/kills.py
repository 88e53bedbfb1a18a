"""Kills runs, resumes them, and looks at what is left."""

import json
import os
import random
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bidex_meta.data import open_dataset
from bidex_meta.runs import RunFolder, read_metrics
from tests.robust.marks import PHASES, read

ROOT = Path(__file__).parents[2]
KILLED = -9


def environment() -> dict[str, str]:
    paths = os.pathsep.join(map(str, (ROOT, ROOT / "algos")))
    return {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}


@contextmanager
def quick_folder() -> Iterator[Path]:
    """A folder in memory where there is one: what SIGKILL leaves does not depend on the disk, which syncs slowly."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None) as name:
        yield Path(name)


@contextmanager
def server() -> Iterator[subprocess.Popen[str]]:
    """The program of ``tests/robust/victims.py``."""
    line = [sys.executable, "-m", "tests.robust.victims"]
    with subprocess.Popen(
        line, cwd=ROOT, env=environment(), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield process
        assert process.stdin is not None
        process.stdin.close()


@dataclass
class Victim:
    """A run that is begun, killed and resumed by jobs of a server.

    Args:
        server: Of :func:`server`.
        arguments: The run's, without its folder.
        path: The run folder.
        checkpoint_seconds: Least time between checkpoints; 0: after every iteration.
    """

    server: subprocess.Popen[str]
    arguments: Sequence[str]
    path: Path
    checkpoint_seconds: float = 0.0
    fell: Counter[str] = field(default_factory=Counter)
    """Kills so far, by the phase they fell in."""

    @property
    def log(self) -> Path:
        return self.path.with_name(f"{self.path.name}.log")

    @property
    def marks(self) -> Path:
        return self.path.with_name(f"{self.path.name}.marks")

    def go_on(self, aim: tuple[str, int] | None = None, after: float | None = None) -> dict[str, Any]:
        """Begins the run, or goes on with it; a kill is counted in ``fell``.

        Args:
            aim: What to die before: a phase or ``operations``, and the number in it.
            after: Seconds of CPU after which it is killed.

        Returns:
            The server's answer.
        """
        begun = (self.path / "config.json").exists()
        words = ["run", "--resume", str(self.path)] if begun else [*self.arguments, "--run-dir", str(self.path)]
        job = {"arguments": words, "folder": str(self.path), "log": str(self.log), "marks": str(self.marks)}
        job |= {"aim": aim, "after": after, "checkpoint_seconds": self.checkpoint_seconds}
        if begun:
            job["arguments"] += ["--episodes", "1"]
        self.marks.unlink(missing_ok=True)
        assert self.server.stdin is not None and self.server.stdout is not None
        self.server.stdin.write(json.dumps(job) + "\n")
        self.server.stdin.flush()
        answer = json.loads(self.server.stdout.readline())
        assert answer["code"] in (0, KILLED), self.log.read_text()
        if answer["code"] == KILLED:
            self.fell[read(self.marks)[0] if self.marks.exists() else PHASES[0]] += 1
        return answer

    def counts(self) -> dict[str, int]:
        """What its last process counted."""
        return read(self.marks)[1]

    def kill_often(self, counts: dict[str, int], seconds: float, draw: random.Random) -> None:
        """Kills it at a random moment, then at a random event of each phase after the first, and lets it end.

        Args:
            counts: Of an unbroken run.
            seconds: Of CPU, which that took.
            draw: Of the moments.
        """
        self.go_on(after=draw.uniform(0.0, seconds / 4))
        for phase in PHASES[1:]:
            if not counts[phase]:
                continue
            # The run must not end before the last kill, so each step goes at most an eighth further.
            most = counts[phase] if phase == PHASES[-1] else max(1, counts[phase] // 8)
            answer = self.go_on(aim=(phase, draw.randint(1, most)))
            assert answer["code"] == KILLED, (phase, self.log.read_text())
        assert self.go_on()["code"] == 0


def bits(value: Any) -> Any:
    """A state as what can be compared by ``==``, bit for bit, NaN too."""
    if isinstance(value, torch.Tensor):
        flat = value.detach().cpu().contiguous().flatten()
        return str(value.dtype), tuple(value.shape), np.asarray(flat.view(torch.uint8)).tobytes() if len(flat) else b""
    if isinstance(value, np.ndarray):
        return str(value.dtype), value.shape, value.tobytes()
    if isinstance(value, dict):
        return {key: bits(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [bits(each) for each in value]
    return value


def outcome(path: Path, names: bool = True) -> dict[str, Any]:
    """All that a run has come to, but for times: files, checkpoints with their worlds, metrics, evaluation.

    Args:
        path: The run folder.
        names: Whether older checkpoints count too; which there are is a matter of time unless each iteration saves.
    """
    folder = RunFolder.open(path)
    files = sorted(str(file.relative_to(path)) for file in path.rglob("*") if not file.name.startswith("events."))
    kept = [path / name for name in files if name.endswith(".pt") and (names or "step_" not in name)]
    found: dict[str, Any] = {"files": [name for name in files if names or "step_" not in name]}
    found |= {file.name: bits(folder.checkpoints.load_one(file)) for file in kept}
    found["newest"], found["best"] = bits(folder.checkpoints.load()), folder.checkpoints.found_of_best()
    rows = read_metrics(path / "metrics.jsonl")
    found["metrics"] = [{k: v for k, v in r.items() if k != "time" and not k.startswith("Perf/")} for r in rows]
    if (path / "replay").exists():
        found["recorded"] = [bits(vars(episode)) for episode in open_dataset(path / "replay").episodes()]
    if (path / "evaluation.json").exists():
        found["evaluation"] = json.loads((path / "evaluation.json").read_text())
        found["evaluation"].pop("run", None)
    return found


def unequal(one: dict[str, Any], other: dict[str, Any], where: str = "") -> list[str]:
    """Where two outcomes differ."""
    if isinstance(one, dict) and isinstance(other, dict):
        missing = [f"{where}/{key}" for key in one.keys() ^ other.keys()]
        return missing + [
            d for key in one.keys() & other.keys() for d in unequal(one[key], other[key], f"{where}/{key}")
        ]
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other) and where != "/files":
        return [d for i, (a, b) in enumerate(zip(one, other, strict=True)) for d in unequal(a, b, f"{where}/{i}")]
    told = f"{where}: {one} {other}" if where == "/files" else where
    return [] if one == other else [told]

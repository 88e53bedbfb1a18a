"""Compare the speed of this code's worlds with another commit's, side by side in one run.

Speeds on a shared machine drift by more than a change gains, so speeds from two separate runs say little. Here each
commit has a process with the same world. The processes alternate, one repeat each. Each pair of repeats gives a ratio.
"""

import contextlib
import io
import json
import os
import statistics
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import tyro

from bidex_meta.errors import BidexError, one_line
from bidex_meta.runs.atomic import Json, write_json
from bidex_meta.runs.versions import git_state
from bidex_meta.utils.memory import usable_cores

HERE = Path(__file__).resolve().parents[2]
"""The checkout that this code runs from."""
_ROWS_OF_A_SUITE_OVER_A_CLASS = 4


def against(
    other: tyro.conf.Positional[str],
    suite: str = "MT4",
    num_envs: int = 1024,
    steps: int = 40,
    repeats: int = 7,
    classes: bool = False,
    threads: int | None = None,
    seed: int = 0,
    out: Path | None = None,
) -> Json:
    """Compare the speed of a suite's world, and of single classes, with other code on the same interpreter.

    Args:
        other: A commit of the git checkout that this code runs from, or a folder with a checkout.
        suite: A suite that exists in both checkouts; each side uses its own definition.
        num_envs: Number of environments of the suite's world; the world of a single class has a quarter of them.
        steps: Number of control steps of each repeat. One more repeat comes first, to warm up.
        repeats: Number of pairs of repeats; medians are reported.
        classes: Also measure each class of the suite on its own, as it is in the suite.
        threads: Engine threads; None: one per CPU.
        seed: Seed of worlds and actions.
        out: JSON file to write the result to; None: only print it.

    Returns:
        ``old`` and ``new`` (git commit, and whether files differ from it), the settings, and ``table`` with a row for
        the suite and for each class. A row has ``old`` and ``new`` (env-steps/s); ``ratio`` (median over pairs of
        repeats; above 1 if this code is faster); ``least`` and ``most`` (smallest and largest ratio of a pair);
        ``cpu`` (ratio of CPU seconds, which other work on the machine affects less); and ``old physics`` and ``new
        physics`` ("time step × substeps" of the engine batches).

    Raises:
        BidexError: A worker reports an error.
        CalledProcessError: git does not know the commit.
    """
    setting = {"suite": suite, "num_envs": num_envs, "threads": threads or usable_cores(), "steps": steps}
    if Path(other).is_dir():
        commit = None
    else:
        commit = _git("rev-parse", "--verify", f"{other}^{{commit}}").decode().strip()
    with checkout(other) as folder, _Worker(folder) as old, _Worker(HERE) as new:
        result: Json = {
            "old": git_state(folder / "bidex_meta") or {"commit": commit, "dirty": False},
            "new": git_state(HERE / "bidex_meta"),
            **setting,
            "table": [],
        }
        common = set(old.ask("classes", checkout=str(folder), suite=suite, seed=seed))
        alone = [name for name in new.ask("classes", checkout=str(HERE), suite=suite, seed=seed) if name in common]
        for task in [None, *(alone if classes else [])]:
            rows = num_envs if task is None else max(1, num_envs // _ROWS_OF_A_SUITE_OVER_A_CLASS)
            world = {"suite": suite, "task": task, "num_envs": rows, "threads": threads, "seed": seed}
            result["table"].append({"what": task or suite, "rows": rows, **_pairs(old, new, world, steps, repeats)})
            if out is not None:
                write_json(out, result)
    return result


def _pairs(old: "_Worker", new: "_Worker", world: Json, steps: int, repeats: int) -> Json:
    """Return one row of the table: both sides' speeds of one world, measured in alternating repeats."""
    physics = {worker: worker.ask("build", **world) for worker in (old, new)}
    walls: dict[_Worker, list[float]] = {old: [], new: []}
    cpus: dict[_Worker, list[float]] = {old: [], new: []}
    for repeat in range(repeats + 1):
        for worker in (old, new) if repeat % 2 else (new, old):  # alternates which side finds a warm machine
            took = worker.ask("step", steps=steps, seed=repeat)
            if repeat:  # the first repeat warms up
                walls[worker].append(took["wall"])
                cpus[worker].append(took["cpu"])
    done = world["num_envs"] * steps
    ratios = _ratios(walls[old], walls[new])
    return {
        "old": round(done / statistics.median(walls[old])),
        "new": round(done / statistics.median(walls[new])),
        "ratio": round(statistics.median(ratios), 4),
        "least": round(min(ratios), 4),
        "most": round(max(ratios), 4),
        "cpu": round(statistics.median(_ratios(cpus[old], cpus[new])), 4),
        "old physics": _told(physics[old]),
        "new physics": _told(physics[new]),
    }


@contextlib.contextmanager
def checkout(other: str) -> Iterator[Path]:
    """Yield the folder of the other code; a commit is unpacked for the duration of the block."""
    with tempfile.TemporaryDirectory(prefix="bidex-meta-") as unpacked:
        folder = Path(other).resolve()
        if not folder.is_dir():
            folder = Path(unpacked).resolve()
            with tarfile.open(fileobj=io.BytesIO(_git("archive", other))) as archive:
                archive.extractall(folder, filter="data")
        yield folder


def _git(*arguments: str) -> bytes:
    done = subprocess.run(["git", *arguments], cwd=HERE, capture_output=True)
    if done.returncode:
        message = one_line(done.stderr.decode(errors="replace"))
        raise BidexError(f"git {' '.join(arguments)} failed: {message}. Name a commit of this repository.")
    return done.stdout


def _ratios(old: list[float], new: list[float]) -> list[float]:
    return [a / b for a, b in zip(old, new, strict=True)]


def _told(batches: list[tuple[float, int]]) -> str:
    """Format engine batches as, e.g., "1/240 s × 4", each kind once."""
    return ", ".join(dict.fromkeys(f"1/{1.0 / time_step:.4g} s × {substeps}" for time_step, substeps in batches))


class _Worker:
    """A process that steps the worlds of one checkout and is called over pipes; it ends with the ``with`` block."""

    def __init__(self, checkout: Path) -> None:
        self._checkout = checkout
        path = [str(checkout), str(checkout / "algos"), os.environ.get("PYTHONPATH", "")]
        # -P keeps the script's own folder off the path; otherwise the files next to it could be imported as modules.
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(Path(__file__).with_name("stepper.py"))],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, path))},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> "_Worker":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()

    def ask(self, name: str, **given: object) -> Any:
        """Call the worker's method of this name and return the method's result."""
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):  # a dead worker is reported below
            self._process.stdin.write(json.dumps([name, given]) + "\n")
            self._process.stdin.flush()
        line = self._process.stdout.readline()
        found = json.loads(line) if line else {"error": f"its process ended (code {self._process.wait()})"}
        if "error" in found:
            raise BidexError(f"The code in {self._checkout} cannot {name}: {found['error']}")
        return found["answer"]

"""How far the runs of a sweep have come, read from their folders, and how long the rest takes."""

import heapq
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

from bidex_meta.errors import BidexError, one_line
from bidex_meta.reading import exists, is_file
from bidex_meta.record.folder import flat
from bidex_meta.record.metrics import last_rows, training_seconds
from bidex_meta.record.stopping import enough
from bidex_meta.sweep.plan import PlannedRun

_FREE = ("steps", "minutes", "evaluate_every", "video_every", "logger", "threads", "seed", "device")
"""Entries of a config in which a folder may differ from the file: a resumed run may be given some anew."""
_TAIL = 4096


@dataclass(frozen=True)
class State:
    """How far a run has come."""

    run: PlannedRun
    """The run."""
    state: str
    """``done``, ``runs``, ``failed`` or ``left``."""
    step: int
    """Environment steps that were logged."""
    goal: int
    """Steps to train for; where a return or a score has ended it, those it made."""
    minutes: float | None
    """Minutes to train for, where time ends it."""
    seconds: float
    """Time of training so far."""
    why: str = ""
    """Of a failed run the last line of its log."""

    @property
    def speed(self) -> float | None:
        """Measured steps a second; None before the first line of metrics."""
        return self.step / self.seconds if self.step and self.seconds else None


def state_of(run: PlannedRun, config: Mapping[str, Any]) -> State:
    """How far a run has come.

    Args:
        run: The run.
        config: As its flags resolve, of any seed.

    Raises:
        BidexError: There is a run in its folder that is of another config, or files that cannot be read.
    """
    goal, minutes, step, seconds = config["steps"], config["minutes"], 0, 0.0
    if not exists(run.folder.config_path):
        why = _why(run)
        return State(run, "failed" if why else "left", 0, goal, minutes, 0.0, why)
    _refuse_another(run, config)
    if is_file(run.folder.metrics_path):
        rows = last_rows(run.folder.metrics_path)
        if rows and rows[-1].get("Perf/training_time") is None:
            rows = run.folder.metrics()  # of an older version
        step, seconds = (rows[-1]["step"] if rows else 0), training_seconds(rows)
        if rows and enough(config, rows[-1]):
            goal = step
    why = ""
    if locked(run):
        state = "runs"
    elif run.folder.evaluated and run.folder.evaluation().get("steps", goal) >= (goal if minutes is None else 0):
        state = "done"
    else:
        why = _why(run)
        state = "failed" if why else "left"
    return State(run, state, step, goal, minutes, seconds, why)


def locked(run: PlannedRun) -> bool:
    """Whether a process trains in a run's folder."""
    if not run.path.is_dir():
        return False
    try:
        with run.folder.locked():
            return False
    except BidexError:
        return True


def log_path(run: PlannedRun) -> Path:
    """What a run has said, over all its starts."""
    return run.path.with_name(f"{run.name}.log")


def failed_path(run: PlannedRun) -> Path:
    """Stands beside a run's folder while its last start has failed, and says why."""
    return run.path.with_name(f"{run.name}.failed")


def last_line(path: Path) -> str:
    """The last line of a log that says anything."""
    if not is_file(path):
        return ""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - _TAIL))
        lines = [line for line in file.read().decode(errors="replace").splitlines() if line.strip()]
    return one_line(lines[-1]) if lines else ""


def seconds_left(states: Sequence[State]) -> list[float | None]:
    """What each run has still to train, by its own measured speed, else by that of its like.

    Its like: other seeds of its arm on its suite, else all arms on its suite, else all. None where nothing is measured.
    """
    return [_left(state, states) for state in states]


def span(left: Sequence[float | None], workers: int) -> float:
    """Seconds until so many workers are through with the runs in their order; those of unknown length take none."""
    ends = [0.0] * workers
    for seconds in left:
        heapq.heapreplace(ends, ends[0] + (seconds or 0.0))
    return max(ends)


def _left(state: State, states: Sequence[State]) -> float | None:
    if state.state == "done":
        return 0.0
    of_time = math.inf if state.minutes is None else max(0.0, 60.0 * state.minutes - state.seconds)
    same = [other for other in states if other.run.subject == state.run.subject]
    like = ([state], [other for other in same if other.run.arm == state.run.arm], same, states)
    speeds = next((found for each in like if (found := [o.speed for o in each if o.speed is not None])), None)
    if speeds is None:
        return None if of_time == math.inf else of_time
    return min(of_time, max(0, state.goal - state.step) / mean(speeds))


def _why(run: PlannedRun) -> str:
    return last_line(failed_path(run))


def _refuse_another(run: PlannedRun, config: Mapping[str, Any]) -> None:
    known, wanted = flat(run.folder.config()), flat(dict(config))
    if run.after is not None:  # another for each seed
        wanted["start_from"] = str(run.after.resolve())
    for name in known.keys() & wanted.keys():
        if name not in _FREE and known[name] != wanted[name]:
            raise BidexError(
                f"{run.path} is a run of another config: {name} is {known[name]} there, not {wanted[name]}. Give the "
                "arm another name, or move the folder away."
            )

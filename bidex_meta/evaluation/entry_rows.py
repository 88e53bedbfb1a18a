"""The results of a class in an entry of the leaderboard, computed from the successes of each task."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from bidex_meta.evaluation.results import MANY_TASKS
from bidex_meta.evaluation.statistics import Estimate, bootstrap, estimate_from
from bidex_meta.runs.atomic import Json
from bidex_meta.utils.validation import Fraction, Whole

ROUNDING = 1e-6  # of stored rates
_Interval = tuple[Fraction, Fraction]


@dataclass(frozen=True)
class ClassRow:
    """The results of a class in a leaderboard entry."""

    success: Fraction
    interval: _Interval | None  # 95 % interval of the mean over runs and tasks; None with a single episode
    solved: Annotated[list[Annotated[list[Whole], Meta(min_length=1)]], Meta(min_length=1)]
    """Successful episodes of each task, one list per run."""


def class_row(solved: list[list[int]], episodes: int) -> Json:
    """Return the results of a class in a leaderboard entry, ready for JSON.

    ``solved`` has the number of successes of each run and task, in ``episodes`` episodes of the task.
    """
    mean = _mean(row_table(solved, episodes))
    return {"success": mean.value, "interval": mean.interval, "solved": solved}


def row_table(solved: list[list[int]], episodes: int) -> np.ndarray:
    """Return success (runs, units). Units are tasks, or episodes if there are fewer than ``MANY_TASKS`` tasks."""
    counts = np.array(solved)
    if counts.shape[1] >= MANY_TASKS:
        return counts / episodes
    table = []
    for run, of_run in enumerate(counts):
        outcomes = (np.arange(episodes) < of_run[:, None]).ravel()
        # Runs are resampled together, so that successes of two runs must not stand side by side.
        table.append(np.random.default_rng(run).permutation(outcomes))
    return np.array(table, dtype=float)


def _mean(table: np.ndarray) -> Estimate:
    """Return the mean of a table (runs, units), with an interval over both."""
    if table.size < 2:
        return Estimate(float(table.mean()), None)

    def means(runs: np.ndarray, units: np.ndarray) -> np.ndarray:
        return table[runs[:, :, None], units[:, None]].mean(axis=(1, 2))

    return estimate_from(float(table.mean()), bootstrap(means, [(len(table),), (table.shape[1],)]))


def faults_of_row(row: ClassRow, runs: int, tasks: range, episodes: int) -> Iterator[str]:
    """Yield a message for each contradiction in the results of one class.

    The results should hold ``runs`` runs. Each run should have played ``episodes`` episodes of each task. ``tasks`` is
    the range of allowed numbers of tasks.
    """
    counts = {len(of_run) for of_run in row.solved}
    if len(row.solved) != runs or len(counts) != 1 or min(counts) not in tasks:
        yield f"solved: expected {tasks[-1]} values of each of {runs} runs, got {[*map(len, row.solved)]}"
        return
    if max(map(max, row.solved)) > episodes:
        yield f"solved: expected at most {episodes} episodes of a task"
        return
    expected = class_row(row.solved, episodes)
    if abs(expected["success"] - row.success) > ROUNDING:
        yield f"success: expected the mean of its tasks, {expected['success']:.4f}, got {row.success:.4f}"
    given = row.interval
    wanted = expected["interval"]
    if given is None or wanted is None:
        apart = given is not wanted
    else:
        apart = max(abs(given[0] - wanted[0]), abs(given[1] - wanted[1])) > ROUNDING
    if apart:
        yield f"interval: expected that of its tasks, {wanted}, got {given}"

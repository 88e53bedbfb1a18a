"""Measures of transfer to a class that the initial policy was not trained on, over several seeds, ready for JSON."""

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np

from bidex_meta.evaluation.comparison import over_runs, series
from bidex_meta.evaluation.statistics import estimate, mean, mean_difference
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import Json

TAG = "Eval/success_rate"
NOTHING = "nothing"  # what runs with a fresh policy start from


def area(steps: np.ndarray, success: np.ndarray, end: float) -> float:
    """Return the mean success over the environment steps 0 to ``end``, by the trapezoid rule.

    Evaluations are at rising ``steps`` (n,), n > 0, with ``success`` (n,) in [0, 1]. Success before the first
    evaluation is taken to equal the first, and success after the last evaluation to equal the last.
    """
    grid = np.unique(np.concatenate([[0.0, end], steps[steps < end]]))
    return float(np.trapezoid(np.interp(grid, steps, success), grid) / end)


def steps_to(steps: np.ndarray, success: np.ndarray, level: float = 0.5) -> int | None:
    """Return the step of the first of two successive evaluations with success of at least ``level``, or None.

    An evaluation has ten episodes, and a single one sometimes reaches one half by chance.
    """
    reached = success >= level
    rows = np.flatnonzero(reached[:-1] & reached[1:])
    return int(steps[rows[0]]) if len(rows) else None


def median_steps(counts: Sequence[int | None]) -> int | None:
    """Return the median (the larger middle value if the count is even); None counts as larger than any number."""
    ranked = sorted(counts, key=lambda steps: np.inf if steps is None else steps)
    return ranked[len(ranked) // 2]


def at_the_end(folders: Sequence[RunFolder]) -> Json:
    """Return success and return in the final evaluation of runs that differ only in the seed."""
    success = []
    returns = []
    for folder in folders:
        rows = folder.evaluation().results.values()
        success.append(float(np.mean([row.success for row in rows])))
        returns.append(float(np.mean([row.mean_return for row in rows])))
    return {"success": over_seeds(success), "return": over_seeds(returns)}


def by_reinforcement(folders: Sequence[RunFolder], end: int) -> Json:
    """Summarise the evaluations of runs that differ only in the seed, during and after training.

    ``end`` is the number of environment steps of training. The result has success and return at the end
    (:func:`at_the_end`), the success ``curve`` over training, success ``at`` 10,000, 100,000, ... steps, the ``area``
    under the curve (:func:`area`), and in ``half`` the steps to a success of one half (:func:`steps_to`).
    """
    curves = [series(folder.metrics(), TAG) for folder in folders]
    at = {}
    for power in range(4, 15):
        step = 10**power
        if step < end:
            at[str(step)] = over_seeds([float(np.interp(step, *curve)) for curve in curves])
    reached = [steps_to(*curve) for curve in curves]
    curve = {}
    for name, values in vars(over_runs(curves)).items():
        curve[name] = None if values is None else values.tolist()
    return at_the_end(folders) | {
        "curve": curve,
        "at": at,
        "area": over_seeds([area(*curve, end) for curve in curves]),
        "half": {"of_seeds": reached, "median": median_steps(reached)},
    }


def over_seeds(of_seeds: list[float]) -> Json:
    """Return the mean of the seeds, its interval (None for a single seed) and the value of each seed."""
    return asdict(estimate(mean, np.array(of_seeds))) | {"of_seeds": of_seeds}


def add_over_nothing(rows: Sequence[Json], measure: str) -> None:
    """Add ``over_nothing`` to each row: its ``measure`` minus that of the same training from scratch, with an interval.

    A row holds the results of one class and one initial policy. The interval is over the seeds of both. The entry is
    None for rows from scratch, and for rows without a counterpart from scratch.
    """
    alone = {(row["class"], row.get("demonstrations")): row for row in rows if row["from"] == NOTHING}
    for row in rows:
        other = alone.get((row["class"], row.get("demonstrations")), row)
        row["over_nothing"] = None
        if other is not row:
            own = np.array(row[measure]["of_seeds"])
            fresh = np.array(other[measure]["of_seeds"])
            row["over_nothing"] = asdict(estimate(mean_difference, own, fresh))

"""What runs say of a class that their policy to start from was not trained on: measures over seeds, ready for JSON."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from bidex_meta.evaluation.comparison import over_runs, series
from bidex_meta.evaluation.statistics import Estimate, bootstrap_interval, mean, mean_difference
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import Json

TAG = "Eval/success_rate"
NOTHING = "nothing"  # what runs with a fresh policy start from


def area(steps: np.ndarray, success: np.ndarray, end: float) -> float:
    """Mean success over the environment steps 0 to ``end``, by the trapezoid rule.

    Evaluations are at rising ``steps`` (n,), n > 0, with success (n,) in [0, 1]; before the first one and after the
    last one it counts as there.
    """
    grid = np.unique(np.concatenate([[0.0, end], steps[steps < end]]))
    return float(np.trapezoid(np.interp(grid, steps, success), grid) / end)


def steps_to(steps: np.ndarray, success: np.ndarray, level: float = 0.5) -> int | None:
    """Steps of the first of two evaluations in a row with this success; None where there are no such two.

    An evaluation is ten episodes: one alone reaches one half by chance now and then.
    """
    reached = success >= level
    found = np.flatnonzero(reached[:-1] & reached[1:])
    return int(steps[found[0]]) if len(found) else None


def median_steps(found: Sequence[int | None]) -> int | None:
    """The median, of an even number the larger of the middle two; None counts as more steps than any number."""
    ranked = sorted(found, key=lambda steps: np.inf if steps is None else steps)
    return ranked[len(ranked) // 2]


def at_the_end(folders: Sequence[RunFolder]) -> Json:
    """Success and return of runs that differ in the seed alone, in their final evaluation (4 episodes of each task)."""
    classes = [folder.evaluation()["policy"]["classes"].values() for folder in folders]
    measures = ("success", "return")
    return {name: estimate([float(np.mean([row[name] for row in rows])) for rows in classes]) for name in measures}


def by_reinforcement(folders: Sequence[RunFolder], end: int) -> Json:
    """The same, and measures of their evaluations while training for ``end`` environment steps."""
    curves = [series(folder.metrics(), TAG) for folder in folders]
    curve: Any = over_runs(curves)
    powers = [10**power for power in range(4, 15) if 10**power < end]
    reached = [steps_to(*each) for each in curves]
    return at_the_end(folders) | {
        "curve": {name: None if values is None else values.tolist() for name, values in vars(curve).items()},
        "at": {str(at): estimate([float(np.interp(at, *each)) for each in curves]) for at in powers},
        "area": estimate([area(*each, end) for each in curves]),
        "half": {"of_seeds": reached, "median": median_steps(reached)},
    }


def estimate(of_seeds: list[float]) -> Json:
    """The mean, its 95 % bootstrap interval over seeds (None of one alone), and each seed."""
    values = np.array(of_seeds)
    return asdict(Estimate(float(values.mean()), bootstrap_interval(mean, values))) | {"of_seeds": of_seeds}


def add_over_nothing(rows: Sequence[Json], measure: str) -> None:
    """Adds to each row how far its measure is above that of the like runs from nothing, seeds of both resampled."""
    alone = {(row["class"], row.get("demonstrations")): row for row in rows if row["from"] == NOTHING}
    for row in rows:
        other = alone.get((row["class"], row.get("demonstrations")), row)
        row["over_nothing"] = None
        if other is not row:
            own, fresh = (np.array(each[measure]["of_seeds"]) for each in (row, other))
            difference = Estimate(float(own.mean() - fresh.mean()), bootstrap_interval(mean_difference, own, fresh))
            row["over_nothing"] = asdict(difference)

"""Metrics of several runs over their training, as curves with intervals over runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.comparison import by_kind, run_kind
from bidex_meta.evaluation.statistics import bootstrap_band
from bidex_meta.record.plots import Curve
from bidex_meta.record.stored import Run

_POINTS = 200


@dataclass(frozen=True)
class History:
    """Runs that differ in the seed alone."""

    label: str
    """The algo, and what tells the group from others of that algo."""
    folders: list[Run]
    """Its runs."""
    curves: dict[str, Curve]
    """Of each tag that a run has logged."""


def read_histories(folders: Sequence[Run]) -> list[History]:
    """Runs, evaluated or not, by group, in the order they are named.

    Raises:
        BidexError: None of them has logged anything.
    """
    runs = [{"kind": run_kind(folder.config()), "folder": folder} for folder in folders]
    histories = []
    for label, members in by_kind(runs):
        of_label = [run["folder"] for run in members]
        histories.append(History(label, of_label, curves_of(of_label)))
    if not any(history.curves for history in histories):
        raise BidexError(f"{folders[0].path} holds nothing yet: nothing to draw. Let the run go on.")
    return histories


def curves_of(runs: Sequence[Run]) -> dict[str, Curve]:
    """Of each tag that one of the runs has logged: see :func:`over_runs`."""
    logged = [run.metrics() for run in runs]
    tags = dict.fromkeys(tag for rows in logged for row in rows for tag in row if tag not in ("step", "time"))
    curves = {tag: over_runs([_series(rows, tag) for rows in logged]) for tag in tags}
    return {tag: curve for tag, curve in curves.items() if curve is not None}


def over_runs(series: Sequence[tuple[np.ndarray, np.ndarray]]) -> Curve | None:
    """Mean and 95 % bootstrap interval over runs; None where no run has a point.

    Args:
        series: Steps and values of each run, each (points,). Several are interpolated to 200 steps between the last of
            their first points and the first of their last ones, so that each point is of all runs; a run without a
            point is left out.
    """
    known = [(steps, values) for steps, values in series if len(steps)]
    if not known:
        return None
    if len(known) == 1:
        return Curve(*known[0], None, None)
    first, last = max(steps[0] for steps, _ in known), min(steps[-1] for steps, _ in known)
    if first > last:  # they have no step in common
        first = last
    grid = np.unique(np.linspace(first, last, _POINTS))
    table = np.array([np.interp(grid, steps, values) for steps, values in known])
    low, high = bootstrap_band(table)
    return Curve(grid, table.mean(axis=0), low, high)


def _series(rows: list[dict[str, Any]], tag: str) -> tuple[np.ndarray, np.ndarray]:
    points = [(row["step"], row[tag]) for row in rows if row.get(tag) is not None]
    steps, values = zip(*points, strict=True) if points else ((), ())
    return np.array(steps, float), np.array(values, float)

"""Several runs beside each other: groups that differ in nothing but the seed, with intervals over seeds."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bidex_meta.config import RunConfig
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.references import rescored
from bidex_meta.evaluation.statistics import Interval, bootstrap_band, bootstrap_interval
from bidex_meta.runs.metrics import training_seconds
from bidex_meta.runs.plots import Curve
from bidex_meta.runs.stored import Run
from bidex_meta.utils.plugins import name_with_object, short_name

_POINTS = 200
"""Of a curve over several runs."""


@dataclass(frozen=True)
class Group:
    """Runs that differ in nothing but the seed; single-task runs of several classes are one group."""

    label: str
    """The algo, and what tells the group from others of that algo."""
    seeds: list[int]
    """In rising order; rows of the arrays below."""
    classes: list[str]
    """Columns of the arrays below."""
    success: np.ndarray
    """Success rate, (seeds, classes)."""
    returns: np.ndarray
    """Mean return, (seeds, classes)."""
    scores: np.ndarray | None
    """Normalised score, (seeds, classes); None where a class has no reference."""
    steps: int
    """Environment steps of a seed, over all its runs; the mean over seeds, which differ where time ended the runs."""
    steps_range: tuple[int, int]
    """Fewest and most steps of a seed."""
    hours: float
    """Mean time of a seed's training, over all its runs, without evaluation."""
    paths: list[Path]
    """Its run folders, or files of JSON."""

    def steps_text(self) -> str:
        """The mean number of steps, with its range where seeds differ."""
        low, high = self.steps_range
        return f"{self.steps:,}" if low == high else f"{self.steps:,} ({low:,} to {high:,})"


@dataclass(frozen=True)
class Estimate:
    """A number with its uncertainty over seeds."""

    value: float
    """The number."""
    interval: Interval | None
    """95 % bootstrap interval, seeds resampled; None with a single one."""

    def text(self, factor: float = 1.0, unit: str = "", form: str = ".1f") -> str:
        """The number times ``factor``, and its interval in brackets where there is one."""
        ends = "" if self.interval is None else f" [{', '.join(f'{factor * end:{form}}' for end in self.interval)}]"
        return f"{factor * self.value:{form}}{unit}{ends}"


def read_groups(runs: Sequence[Run]) -> list[Group]:
    """Evaluated runs by group, in the order they are named.

    Raises:
        BidexError: A run is not evaluated, two are the same, or a group's seeds do not cover the same classes.
    """
    return [_group(label, members) for label, members in by_kind([_read(run) for run in runs])]


def group_of(label: str, runs: Sequence[Run]) -> Group:
    """Evaluated runs that the caller takes as seeds of one group.

    Raises:
        BidexError: As :func:`read_groups`.
    """
    return _group(label, [_read(run) for run in runs])


def run_kind(config: RunConfig[Any], split: str = "train") -> dict[str, Any]:
    """What runs that are compared as one have in common: all of the config that matters but the seed."""
    kind = {"algo": config.algo, "on": config.suite or "one class at a time", "steps": config.steps}
    kind |= {"num_envs": config.num_envs, "minutes": config.minutes, "split": split}
    kind |= {"stop_at_return": config.stop_at_return, "stop_at_success": config.stop_at_success}
    kind["stop_at_score"] = config.stop_at_score
    kind["started"] = "afresh" if config.start_from is None else "from another run"  # which: one for each seed
    kind |= {"base": config.base, "points": config.points, "object": config.object}
    kind |= {"dataset": _data(config, config.dataset), "demonstrations": _data(config, config.demonstrations)}
    return kind | {f"learner.{name}": value for name, value in config.learner_values.items()}


def _data(config: RunConfig[Any], names: Sequence[str]) -> str | None:
    """Data sets by their names; of those called as the run's class the kind alone, or classes were no one group."""
    own = "" if config.task is None else f"{name_with_object(short_name(config.task), config.object)}/"
    return " + ".join(name.removeprefix(own) for name in names) or None


def by_kind(runs: Sequence[dict[str, Any]]) -> list[tuple[str, list[dict[str, Any]]]]:
    """Runs of the same ``kind`` together, in the order they are named; with a label that tells them from others."""
    kinds: dict[str, list[dict[str, Any]]] = {}
    for run in runs:
        kinds.setdefault(json.dumps(run["kind"], sort_keys=True), []).append(run)
    differing = _differing([members[0]["kind"] for members in kinds.values()])
    return [(_label(members[0]["kind"], differing), members) for members in kinds.values()]


def iqm(values: np.ndarray) -> Estimate:
    """Interquartile mean over seeds and classes (seeds, classes), and its interval over seeds."""
    return Estimate(_iqm(values), _interval(lambda rows: _iqm(values[rows]), len(values)))


def estimates(groups: Sequence[Group]) -> dict[str, list[tuple[str, float, Interval | None]]]:
    """What a picture of groups shows: by title the label, interquartile mean and interval of each."""
    found: dict[str, list[tuple[str, float, Interval | None]]] = {}
    for group in groups:
        for title, values, factor in (("success, IQM (%)", group.success, 100.0), ("score, IQM", group.scores, 1.0)):
            if values is not None:
                of_all = iqm(values)
                ends = of_all.interval and (factor * of_all.interval[0], factor * of_all.interval[1])
                found.setdefault(title, []).append((group.label, factor * of_all.value, ends))
    return found


def iqm_difference(a: np.ndarray, b: np.ndarray) -> Estimate:
    """Interquartile mean of ``a`` minus that of ``b``, each (seeds, classes), seeds of both resampled."""
    value = _iqm(a) - _iqm(b)
    if min(len(a), len(b)) < 2:
        return Estimate(value, None)
    interval = bootstrap_interval(
        lambda i, j, axis: _along(i, j, lambda p, q: _iqm(a[p]) - _iqm(b[q])), np.arange(len(a)), np.arange(len(b))
    )
    return Estimate(value, interval)


def success_over(group: Group, first: Group) -> Estimate | None:
    """Success above the first group's; None of the first itself, and of other classes than its own."""
    known = group is not first and set(group.classes) == set(first.classes)
    return iqm_difference(group.success, first.success) if known else None


def score_over(group: Group, first: Group) -> Estimate | None:
    """Normalised score above the first group's; None too where either is unknown."""
    known = group is not first and set(group.classes) == set(first.classes)
    if not known or group.scores is None or first.scores is None:
        return None
    return iqm_difference(group.scores, first.scores)


def _iqm(values: np.ndarray) -> float:
    from scipy.stats import trim_mean

    return float(trim_mean(values.ravel(), 0.25))


def _interval(statistic: Any, seeds: int) -> Interval | None:
    """All classes of a seed are resampled together: they come from one run."""
    return bootstrap_interval(lambda rows, axis: _along(rows, rows, lambda p, _: statistic(p)), np.arange(seeds))


def _along(i: np.ndarray, j: np.ndarray, statistic: Any) -> Any:
    """``statistic`` of the last axes of two arrays of resampled rows (..., seeds)."""
    if i.ndim == 1:
        return statistic(i.astype(int), j.astype(int))
    return np.array([statistic(p.astype(int), q.astype(int)) for p, q in zip(i, j, strict=True)])


def _read(run: Run) -> dict[str, Any]:
    config, found, goal = run.config(), run.evaluation(), run.goal
    steps = found.get("steps", goal)
    if steps < goal:
        raise BidexError(
            f"The evaluation of {run.path} is of {steps:,} steps, but the run goes on to {goal:,}. Let it end, or "
            f"write it anew: {run.again}"
        )
    return {
        "path": run.path,
        "kind": run_kind(config, found.get("split", "train")),
        "seed": config.seed,
        "classes": scored_classes(run),
        "seconds": training_seconds(run.metrics()),
        "steps": goal,
    }


def classes_of(
    found: dict[str, Any], told: Callable[[dict[str, Any]], dict[str, Any]] = lambda rows: rows
) -> dict[str, Any]:
    """Of a meta-test the classes after adaptation, train and test apart: ML1's splits hold the same class.

    Args:
        found: An evaluation.
        told: What becomes of the rows of a split, by class.
    """
    if "splits" in found:
        after = {split: told(part["after"]["classes"]) for split, part in found["splits"].items()}
        return {f"{name} ({split})": row for split, rows in after.items() for name, row in rows.items()}
    return told(found.get("policy", found)["classes"])


def scored_classes(run: Run) -> dict[str, Any]:
    """As :func:`classes_of` of its evaluation, with scores by today's references."""
    config = run.config()
    return classes_of(run.evaluation(), lambda rows: rescored(rows, config))


def _differing(kinds: list[dict[str, Any]]) -> dict[str, set[str]]:
    """For each algo the entries in which its groups differ."""
    found: dict[str, set[str]] = {}
    for kind in kinds:
        same = [other for other in kinds if other["algo"] == kind["algo"]]
        found[kind["algo"]] = {
            name for other in same for name in kind.keys() | other.keys() if kind.get(name) != other.get(name)
        }
    return found


def _label(kind: dict[str, Any], differing: dict[str, set[str]]) -> str:
    told = [f"{name.removeprefix('learner.')} {kind.get(name)}" for name in sorted(differing[kind["algo"]])]
    return ", ".join([kind["algo"], *told])


def _group(label: str, members: list[dict[str, Any]]) -> Group:
    rows: dict[int, dict[str, Any]] = {}
    for run in members:
        row = rows.setdefault(run["seed"], {"classes": {}, "seconds": 0.0, "steps": 0})
        twice = row["classes"].keys() & run["classes"].keys()
        if twice:
            raise BidexError(f"{run['path']} is the second run of {label} with seed {run['seed']} on {min(twice)}.")
        row["classes"] |= run["classes"]
        row["seconds"], row["steps"] = row["seconds"] + run["seconds"], row["steps"] + run["steps"]
    seeds, classes = sorted(rows), list(rows[members[0]["seed"]]["classes"])
    for seed in seeds:
        if set(rows[seed]["classes"]) != set(classes):
            raise BidexError(
                f"Expected the same classes from every seed of {label}, but seed {seeds[0]} has {', '.join(classes)} "
                f"and seed {seed} {', '.join(rows[seed]['classes'])}. Leave out what is not complete."
            )

    def table(name: str) -> np.ndarray:
        return np.array([[rows[seed]["classes"][c][name] for c in classes] for seed in seeds], dtype=float)

    scores, steps = table("score"), [rows[seed]["steps"] for seed in seeds]
    return Group(
        label=label,
        seeds=seeds,
        classes=classes,
        success=table("success"),
        returns=table("return"),
        scores=None if np.isnan(scores).any() else scores,
        steps=round(sum(steps) / len(steps)),
        steps_range=(min(steps), max(steps)),
        hours=float(np.mean([rows[seed]["seconds"] for seed in seeds])) / 3600.0,
        paths=[run["path"] for run in members],
    )


@dataclass(frozen=True)
class History:
    """Runs that differ in the seed alone."""

    label: str
    """The algo, and what tells the group from others of that algo."""
    runs: list[Run]
    """Its runs."""
    curves: dict[str, Curve]
    """Of each tag that a run has logged."""


def read_histories(runs: Sequence[Run]) -> list[History]:
    """Runs, evaluated or not, by group, in the order they are named.

    Raises:
        BidexError: None of them has logged anything.
    """
    kinds = [{"kind": run_kind(run.config()), "run": run} for run in runs]
    groups = [(label, [member["run"] for member in members]) for label, members in by_kind(kinds)]
    histories = [History(label, members, curves_of(members)) for label, members in groups]
    if not any(history.curves for history in histories):
        raise BidexError(f"{runs[0].path} holds nothing yet: nothing to draw. Let the run go on.")
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

"""Comparison of runs: groups of runs that differ only in the seed, with intervals over seeds."""

import json
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.references import rescored
from bidex_meta.evaluation.statistics import Estimate, Interval, bootstrap_band, iqm_difference, iqm_over_seeds
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.evaluations import ClassSummary, PolicyEvaluation
from bidex_meta.runs.folder import AnyConfig
from bidex_meta.runs.metrics import training_seconds
from bidex_meta.runs.plots import Curve
from bidex_meta.runs.provenance import split_by_worlds
from bidex_meta.runs.stored import Run, StoredRun
from bidex_meta.utils.files import portable
from bidex_meta.utils.plugins import name_with_object, short_name

_SETTINGS = ("algo", "steps", "num_envs", "minutes", "stop_at_return", "stop_at_success", "stop_at_score")
_SETTINGS += ("base", "points", "touch", "object", "tasks_per_class", "switches")
_MADE = "made with"  # entry for versions that differ from those of other runs on the same worlds
_POINTS = 200  # number of points of a curve over several runs


@dataclass(frozen=True)
class Group:
    """Runs that differ only in the seed; single-task runs of several classes are one group."""

    label: str  # the algo, and the settings that differ from other groups with the same algo
    seeds: list[int]  # in rising order; rows of the arrays below
    classes: list[str]  # class names, columns of the arrays below
    success: np.ndarray  # success rate, (seeds, classes)
    returns: np.ndarray  # mean return, (seeds, classes)
    scores: np.ndarray | None  # normalised score, (seeds, classes); None if a class has no reference
    steps: int  # environment steps, summed over the runs of a seed, then averaged over seeds
    steps_range: tuple[int, int]  # smallest and largest number of steps of a seed
    hours: float  # hours of training without evaluation, summed and averaged like ``steps``
    paths: list[Path]  # the runs' folders, or JSON files

    def steps_text(self) -> str:
        """Return the mean number of steps, with its range if seeds differ."""
        low, high = self.steps_range
        if low == high:
            return f"{self.steps:,}"
        return f"{self.steps:,} ({low:,} to {high:,})"


def read_groups(runs: Sequence[Run]) -> list[Group]:
    """Return evaluated runs by group, in the order they are named.

    Raises BidexError if a run is not evaluated, two runs are the same, or a group's seeds cover different classes.
    """
    kinds = [run_kind(run.config(), run.evaluation().split) for run in runs]
    return [group_of(label, members) for label, members in _by_kind(kinds, runs)]


def run_kind(config: AnyConfig, split: str = "train") -> Json:
    """Return the settings that runs of one group share: all settings that matter, without the seed."""
    kind = {name: vars(config)[name] for name in _SETTINGS}
    kind["on"] = config.suite or "one class at a time"
    kind["split"] = split
    # The name of the other run is left out, because each seed may start from its own run.
    kind["started"] = "afresh" if config.start_from is None else "from another run"
    kind["dataset"] = _data(config, config.dataset)
    kind["demonstrations"] = _data(config, config.demonstrations)
    # Names of teachers are left out, because each single-class run of a group has a teacher for its own class.
    teachers = {"scripts" if name == "scripts" else "runs" for name in config.teacher}
    kind["teacher"] = " + ".join(sorted(teachers)) or None
    for name, value in config.learner_values.items():
        kind[f"learner.{name}"] = value
    return kind


def _data(config: AnyConfig, names: Sequence[str]) -> str | None:
    """Return the names of data sets without the prefix of the run's own class: the rest is equal within a group."""
    if config.task is None:
        own = ""
    else:
        own = f"{name_with_object(short_name(config.task), config.object)}/"
    return " + ".join(name.removeprefix(own) for name in names) or None


def _by_kind(kinds: Sequence[Json], runs: Sequence[Run]) -> list[tuple[str, list[Run]]]:
    """Return the labels and runs of groups of one kind, in the order in which they are named.

    A label is the name of a study's arm if all runs of the group, and of no other group, come from this arm; otherwise
    it consists of the settings that differ. Runs on different worlds form separate groups, whose labels name the
    difference.
    """
    _check_copies(runs)
    members: dict[str, list[Run]] = {}
    unique: dict[str, Json] = {}
    for kind, versions, run in zip(kinds, split_by_worlds(runs), runs, strict=True):
        kind = {**kind, _MADE: [f"{name} {value}" for name, value in versions.items()]}
        key = json.dumps(kind, sort_keys=True)
        unique[key] = kind
        members.setdefault(key, []).append(run)
    arms = [_arms_of(group) for group in members.values()]
    labelled = []
    for arm, (key, kind) in zip(arms, unique.items(), strict=True):
        if len(arm) == 1 and arms.count(arm) == 1:
            name = next(iter(arm))
        else:
            name = None
        label = name or _differing_settings(kind, unique.values())
        labelled.append((", ".join([label, *kind[_MADE]]), members[key]))
    return labelled


def _arms_of(runs: Sequence[Run]) -> set[str | None]:
    """Return the arms of studies that runs come from; run folders have the arm None."""
    return {run.arm if isinstance(run, StoredRun) else None for run in runs}


def _differing_settings(kind: Json, kinds: Iterable[Json]) -> str:
    """Return the learner's name and the settings that are not the same in all kinds with this learner."""
    others = [other for other in kinds if other["algo"] == kind["algo"]]
    texts = [kind["algo"]]
    for name in sorted(set().union(*others) - {_MADE}):
        if any(other.get(name) != kind.get(name) for other in others):
            texts.append(f"{name.removeprefix('learner.')} {portable(kind.get(name))}")
    return ", ".join(texts)


def _check_copies(runs: Sequence[Run]) -> None:
    """Raise BidexError if one run is a copy of another, that is, if the times in their metrics are equal."""
    known: dict[tuple[float, ...], Path] = {}
    for run in runs:
        times = tuple(row["time"] for row in run.metrics() if row.get("time") is not None)
        if len({*times}) > 1 and known.setdefault(times, run.path) != run.path:
            raise BidexError(f"{run.path} is a copy of {known[times]}: a run counts as one seed. Name it once.")


def estimates(groups: Sequence[Group]) -> dict[str, list[tuple[str, float, Interval | None]]]:
    """Return the content of a picture of groups, by title: label, interquartile mean and interval of each group."""
    pictured: dict[str, list[tuple[str, float, Interval | None]]] = {}
    for group in groups:
        for title, values, factor in (("success, IQM (%)", group.success, 100.0), ("score, IQM", group.scores, 1.0)):
            if values is None:
                continue
            measured = iqm_over_seeds(values)
            interval = None
            if measured.interval is not None:
                low, high = measured.interval
                interval = (factor * low, factor * high)
            pictured.setdefault(title, []).append((group.label, factor * measured.value, interval))
    return pictured


def success_over(group: Group, first: Group) -> Estimate | None:
    """Return the difference in success from the first group.

    The result is None for the first group, and for groups with other classes.
    """
    if not _comparable(group, first):
        return None
    return iqm_difference(group.success, first.success)


def score_over(group: Group, first: Group) -> Estimate | None:
    """Return the difference in normalised score from the first group.

    The result is None in the same cases as in :func:`success_over`, and if either score is unknown.
    """
    if not _comparable(group, first) or group.scores is None or first.scores is None:
        return None
    return iqm_difference(group.scores, first.scores)


def _comparable(group: Group, first: Group) -> bool:
    return group is not first and set(group.classes) == set(first.classes)


def scored_classes(run: Run) -> dict[str, ClassSummary]:
    """Return the ``results`` of the run's evaluation, with scores computed from the installed references."""
    config = run.config()
    evaluation = run.evaluation()
    if isinstance(evaluation, PolicyEvaluation):
        return rescored(evaluation.policy.classes, config)
    splits = {}
    for split, part in evaluation.splits.items():
        after = replace(part.after, classes=rescored(part.after.classes, config))
        splits[split] = replace(part, after=after)
    return replace(evaluation, splits=splits).results


def group_of(label: str, runs: Sequence[Run]) -> Group:
    """Return the group of evaluated runs that differ only in the seed; errors are those of :func:`read_groups`."""
    by_seed = defaultdict[int, dict[str, ClassSummary]](dict)
    seconds = defaultdict[int, float](float)
    steps = defaultdict[int, int](int)
    for run in runs:
        seed = run.config().seed
        goal = run.goal
        own = scored_classes(run)
        evaluated = run.evaluation().steps
        if evaluated is not None and evaluated < goal:
            raise BidexError(
                f"The evaluation of {run.path} is of {evaluated:,} steps, but the run continues to {goal:,}. Let it "
                f"end, or write it again: {run.again}"
            )
        if twice := by_seed[seed].keys() & own.keys():
            raise BidexError(f"{run.path} is the second run of {label} with seed {seed} on {min(twice)}.")
        by_seed[seed] |= own
        seconds[seed] += training_seconds(run.metrics())
        steps[seed] += goal
    seeds = sorted(by_seed)
    classes = list(by_seed[next(iter(by_seed))])
    for seed in seeds:
        if set(by_seed[seed]) != set(classes):
            raise BidexError(
                f"Expected the same classes from every seed of {label}, but seed {seeds[0]} has {', '.join(classes)} "
                f"and seed {seed} {', '.join(by_seed[seed])}. Leave incomplete seeds out."
            )

    def table(measure: str) -> np.ndarray:
        rows = [[getattr(by_seed[seed][name], measure) for name in classes] for seed in seeds]
        return np.array(rows, dtype=float)

    scores = table("score")
    return Group(
        label=label, seeds=seeds, classes=classes, success=table("success"), returns=table("mean_return"),
        scores=None if np.isnan(scores).any() else scores, steps=round(sum(steps.values()) / len(steps)),
        steps_range=(min(steps.values()), max(steps.values())),
        hours=float(np.mean([seconds[seed] for seed in seeds])) / 3600.0, paths=[run.path for run in runs],
    )  # fmt: skip


@dataclass(frozen=True)
class History:
    """Curves of runs that differ only in the seed."""

    label: str  # label as in :class:`Group`
    runs: list[Run]
    curves: dict[str, Curve]  # curve of each tag that a run has logged


def read_histories(runs: Sequence[Run]) -> list[History]:
    """Return runs, evaluated or not, by group, in the order they are named; raise BidexError if no run has metrics."""
    groups = _by_kind([run_kind(run.config()) for run in runs], runs)
    histories = [History(label, members, curves_of(members)) for label, members in groups]
    if not any(history.curves for history in histories):
        raise BidexError(f"{runs[0].path} has no metrics to draw yet. Let the run continue.")
    return histories


def curves_of(runs: Sequence[Run]) -> dict[str, Curve]:
    """Return the curve over runs (:func:`over_runs`) of each tag that at least one run has logged."""
    logged = [run.metrics() for run in runs]
    tags: dict[str, None] = {}  # tags in the order in which they were first logged
    for rows in logged:
        for row in rows:
            tags |= dict.fromkeys(row)
    curves = {}
    for tag in tags:
        if tag in ("step", "time"):
            continue
        curve = over_runs([series(rows, tag) for rows in logged])
        if curve is not None:
            curves[tag] = curve
    return curves


def over_runs(series: Sequence[tuple[np.ndarray, np.ndarray]]) -> Curve | None:
    """Return the mean over runs and its 95 % bootstrap interval from steps and values (points,); None without points.

    Several runs are interpolated to 200 steps. The steps lie between the latest first point and the earliest last
    point of the runs, so that every run has a value there. A run without points is left out.
    """
    known = [(steps, values) for steps, values in series if len(steps)]
    if not known:
        return None
    if len(known) == 1:
        return Curve(*known[0], None, None)
    last = min(steps[-1] for steps, _ in known)
    first = min(last, max(steps[0] for steps, _ in known))  # the runs may have no step in common
    grid = np.unique(np.linspace(first, last, _POINTS))
    table = np.array([np.interp(grid, steps, values) for steps, values in known])
    low, high = bootstrap_band(table)
    return Curve(grid, table.mean(axis=0), low, high)


def series(rows: list[Json], tag: str) -> tuple[np.ndarray, np.ndarray]:
    """Return steps and values (points,) of a tag from the rows of a run's metrics that have the tag."""
    rows = [row for row in rows if row.get(tag) is not None]
    return np.array([row["step"] for row in rows], float), np.array([row[tag] for row in rows], float)

"""Comparison of runs: groups of runs that differ only in the seed, with intervals over seeds."""

import json
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.references import rescored, version_of
from bidex_meta.evaluation.statistics import Estimate, Interval, bootstrap_band, iqm_difference, iqm_over_seeds
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.evaluations import (
    ClassSummary,
    Evaluated,
    MetaTestEvaluation,
    PolicyEvaluation,
    unusual_settings,
)
from bidex_meta.runs.folder import AnyConfig
from bidex_meta.runs.metrics import training_seconds
from bidex_meta.runs.plots import Curve
from bidex_meta.runs.provenance import split_by_worlds
from bidex_meta.runs.stored import Run, StoredRun
from bidex_meta.utils.files import portable
from bidex_meta.utils.plugins import name_with_object, short_name

_SETTINGS = ("algo", "steps", "num_envs", "minutes", "stop_at_return", "stop_at_success", "stop_at_score")
_SETTINGS += ("base", "points", "touch", "object", "tasks_per_class", "switches", "processes")
_MADE = "made with"  # entry for versions that differ from those of other runs on the same worlds
_POINTS = 200  # number of points of a curve over several runs


@dataclass(frozen=True)
class Group:
    """Results of runs that differ only in the seed.

    Runs that each train on a single class may together form one group: a seed then has one run per class.
    """

    label: str  # the algo, and the settings that differ from other groups with the same algo
    seeds: list[int]  # in rising order; rows of the arrays below
    classes: list[str]  # class names, columns of the arrays below
    success: np.ndarray  # success rate, (seeds, classes)
    returns: np.ndarray  # mean return, (seeds, classes)
    scores: np.ndarray | None  # score, (seeds, classes); None if a class has no reference
    steps: int  # environment steps, summed over the runs of a seed, then averaged over seeds
    version: int  # 2: rules of version 2, whose success and score mean something else than version 1's
    settings: list[str]  # split and randomisation of the evaluations, if they are not the usual ones
    steps_range: tuple[int, int]  # smallest and largest number of steps of a seed
    hours: float  # hours of training without evaluation, summed and averaged like ``steps``
    paths: list[Path]  # the runs' folders, or JSON files

    def steps_text(self) -> str:
        """Return, as text, the mean number of environment steps over seeds, with the range if seeds differ."""
        low, high = self.steps_range
        if low == high:
            return f"{self.steps:,}"
        return f"{self.steps:,} ({low:,} to {high:,})"


def read_groups(runs: Sequence[Run]) -> list[Group]:
    """Group evaluated runs that differ only in the seed; groups are in the order of their first runs.

    Raises BidexError if a run is not evaluated, two runs are the same, or a group's seeds cover different classes.
    """
    kinds = [run_kind(run.config(), run.evaluation().split) | _played(run.evaluation()) for run in runs]
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


def _played(evaluation: Evaluated) -> Json:
    """Return the settings of an evaluation on which success depends."""
    found: Json = {"randomised": evaluation.randomisation}
    if isinstance(evaluation, MetaTestEvaluation):
        for split, part in evaluation.splits.items():
            found[f"shots on {split}"] = f"{part.shots} of {part.rollouts}"
    return found


def _data(config: AnyConfig, names: Sequence[str]) -> str | None:
    """Return the names of a run's data sets, joined by " + ", or None if there are none.

    If a name begins with the class that the run trains on, this prefix is removed, so that single-class runs on data
    sets of the same kind fall into one group.
    """
    if config.task is None:
        own = ""
    else:
        own = f"{name_with_object(short_name(config.task), config.object)}/"
    return " + ".join(name.removeprefix(own) for name in names) or None


def _by_kind(kinds: Sequence[Json], runs: Sequence[Run]) -> list[tuple[str, list[Run]]]:
    """Group runs with equal settings (``kinds``), and return each group's label and runs.

    Groups are in the order in which their first runs appear. Runs of a study have an arm, the name of their
    configuration in the study. If all runs of a group, and no other runs, come from one arm, the group's label is the
    arm. Otherwise the label lists the settings that differ between groups. Runs whose worlds differ, for example in a
    version, form separate groups, and their labels name the difference.
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
    """Return the set of arms (names of configurations in a study) that the runs come from.

    A run folder belongs to no study, so its arm is None.
    """
    return {run.arm if isinstance(run, StoredRun) else None for run in runs}


def _differing_settings(kind: Json, kinds: Iterable[Json]) -> str:
    """Return a label: the learner's name, and the settings in which groups of runs with this learner differ.

    ``kind`` holds the settings of the group that is labelled, and ``kinds`` holds the settings of all groups.
    """
    others = [other for other in kinds if other["algo"] == kind["algo"]]
    texts = [kind["algo"]]
    for name in sorted(set().union(*others) - {_MADE}):
        if any(other.get(name) != kind.get(name) for other in others):
            texts.append(f"{name.removeprefix('learner.')} {portable(kind.get(name))}")
    return ", ".join(texts)


def _check_copies(runs: Sequence[Run]) -> None:
    """Raise BidexError if one run is a copy of another, or of its beginning: the times in their metrics are equal."""
    known = []
    for run in runs:
        times = [row["time"] for row in run.metrics() if row.get("time") is not None]
        if len({*times}) > 1:
            known.append((times, run.path))
    # After sorting, a list of times comes directly before those that begin with it.
    for (first, original), (second, path) in pairwise(sorted(known)):
        if second[: len(first)] == first and path != original:
            raise BidexError(f"{path} is a copy of {original}: a run counts as one seed. Name it once.")


def estimates(groups: Sequence[Group]) -> dict[str, list[tuple[str, float, Interval | None]]]:
    """Return the data of a plot that compares groups of runs, by the title of the panel.

    A panel shows success or score. It has a label, an interquartile mean and its interval for each group.
    """
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
    """Return the interquartile mean of a group's success minus that of the first group, with an interval over seeds.

    The result is None if ``group`` is the first group, or if the two groups have different classes or versions.
    """
    if not _comparable(group, first):
        return None
    return iqm_difference(group.success, first.success)


def score_over(group: Group, first: Group) -> Estimate | None:
    """Return the interquartile mean of a group's score minus that of the first group, with an interval.

    The result is None if ``group`` is the first group, if the groups have different classes or versions, or if either
    group has no scores.
    """
    if not _comparable(group, first) or group.scores is None or first.scores is None:
        return None
    return iqm_difference(group.scores, first.scores)


def _comparable(group: Group, first: Group) -> bool:
    return group is not first and (set(group.classes), group.version) == (set(first.classes), first.version)


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
        steps_range=(min(steps.values()), max(steps.values())), version=version_of(runs[0].config(), by_seed[seeds[0]]),
        settings=unusual_settings(runs[0].evaluation()),
        hours=float(np.mean([seconds[seed] for seed in seeds])) / 3600.0, paths=[run.path for run in runs],
    )  # fmt: skip


@dataclass(frozen=True)
class History:
    """Curves of runs that differ only in the seed."""

    label: str  # label as in :class:`Group`
    runs: list[Run]
    curves: dict[str, Curve]  # curve of each tag that a run has logged


def read_histories(runs: Sequence[Run]) -> list[History]:
    """Group runs that differ only in the seed, and return the training curves of each group.

    The runs need not be evaluated. Raises BidexError if no run has metrics, or if two runs of a group have the same
    seed and class.
    """
    groups = _by_kind([run_kind(run.config()) for run in runs], runs)
    for label, members in groups:
        _check_seeds(label, members)
    histories = [History(label, members, curves_of(members)) for label, members in groups]
    if not any(history.curves for history in histories):
        raise BidexError(f"{runs[0].path} has no metrics to draw yet. Let the run continue.")
    return histories


def _check_seeds(label: str, runs: Sequence[Run]) -> None:
    """Raise BidexError if two runs of a group have the same seed and class, because they would count as two seeds."""
    known = set()
    for run in runs:
        config = run.config()
        if (config.seed, config.task) in known:
            subject = config.task or config.suite
            raise BidexError(f"{run.path} is the second run of {label} with seed {config.seed} on {subject}.")
        known.add((config.seed, config.task))


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
    """Return the mean curve over runs, with its 95 % bootstrap interval; None if no run has points.

    ``series`` holds the steps (points,) and values (points,) of each run. The curves of several runs are interpolated
    to 200 steps between the latest first point and the earliest last point, so that every run has a value there. A run
    without points is left out. With a single run, its own points are returned without an interval.
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
    """Return the steps (points,) and values (points,) of one metric, ``tag``, from the rows of a run's metrics.

    Rows without a value for this tag are left out.
    """
    rows = [row for row in rows if row.get(tag) is not None]
    return np.array([row["step"] for row in rows], float), np.array([row[tag] for row in rows], float)

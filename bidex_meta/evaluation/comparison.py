"""Several runs beside each other: groups that differ in nothing but the seed, with intervals over seeds."""

import json
from collections import defaultdict
from collections.abc import Sequence
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
_SETTINGS += ("base", "points", "object")
_MADE = "made with"  # the entry of a kind with what tells its worlds from others
_POINTS = 200  # of a curve over several runs


@dataclass(frozen=True)
class Group:
    """Runs that differ in nothing but the seed; single-task runs of several classes are one group."""

    label: str  # the algo, and settings that differ from other groups of that algo
    seeds: list[int]  # in rising order; rows of the arrays below
    classes: list[str]  # columns of the arrays below
    success: np.ndarray  # success rate, (seeds, classes)
    returns: np.ndarray  # mean return, (seeds, classes)
    scores: np.ndarray | None  # normalised score, (seeds, classes); None where a class has no reference
    steps: int  # environment steps of a seed, over all its runs: the mean over seeds, which may differ
    steps_range: tuple[int, int]  # fewest and most steps of a seed
    hours: float  # mean time of a seed's training, over all its runs, without evaluation
    paths: list[Path]  # its run folders, or files of JSON

    def steps_text(self) -> str:
        """Return the mean number of steps, with its range if seeds differ."""
        low, high = self.steps_range
        if low == high:
            return f"{self.steps:,}"
        return f"{self.steps:,} ({low:,} to {high:,})"


def read_groups(runs: Sequence[Run]) -> list[Group]:
    """Return evaluated runs by group, in the order they are named.

    Raises BidexError if one is not evaluated, two are the same, or a group's seeds cover different classes.
    """
    kinds = [run_kind(run.config(), run.evaluation().split) for run in runs]
    return [group_of(label, members) for label, members in _by_kind(kinds, runs)]


def run_kind(config: AnyConfig, split: str = "train") -> Json:
    """The settings that runs compared as one share: all of the config that matters but the seed."""
    kind = {name: vars(config)[name] for name in _SETTINGS}
    kind |= {"on": config.suite or "one class at a time", "split": split}
    kind["started"] = "afresh" if config.start_from is None else "from another run"  # which: one for each seed
    kind |= {"dataset": _data(config, config.dataset), "demonstrations": _data(config, config.demonstrations)}
    # Of runs not which: a group's runs of single classes each have one for their own.
    kind["teacher"] = (
        " + ".join(sorted({"scripts" if name == "scripts" else "runs" for name in config.teacher})) or None
    )
    return kind | {f"learner.{name}": value for name, value in config.learner_values.items()}


def _data(config: AnyConfig, names: Sequence[str]) -> str | None:
    """Data sets by their names; of those called as the run's class the kind alone, or classes were no one group."""
    if config.task is None:
        own = ""
    else:
        own = f"{name_with_object(short_name(config.task), config.object)}/"
    return " + ".join(name.removeprefix(own) for name in names) or None


def _by_kind(kinds: Sequence[Json], runs: Sequence[Run]) -> list[tuple[str, list[Run]]]:
    """Runs of the same kind together, in the order they are named, with a label each.

    That is the name of a study's arm where all runs of the group come from it and no other group's do, else the
    settings that differ. Runs that were made with different worlds are apart, and the label names these.
    """
    _check_copies(runs)
    members: dict[str, list[Run]] = {}
    unique: dict[str, Json] = {}
    for kind, made, run in zip(kinds, split_by_worlds(runs), runs, strict=True):
        kind = {**kind, _MADE: [f"{name} {value}" for name, value in made.items()]}
        key = json.dumps(kind, sort_keys=True)
        unique[key] = kind
        members.setdefault(key, []).append(run)
    groups = []
    for key, kind in unique.items():
        others = [other for other in unique.values() if other["algo"] == kind["algo"]]
        names = {name for a in others for b in others for name in a.keys() | b.keys() if a.get(name) != b.get(name)}
        names -= {_MADE}
        differing = [f"{name.removeprefix('learner.')} {portable(kind.get(name))}" for name in sorted(names)]
        groups.append((", ".join([kind["algo"], *differing]), members[key]))
    arms = [{run.arm if isinstance(run, StoredRun) else None for run in mine} for _, mine in groups]
    names = [arm.pop() if len(arm) == 1 and arms.count(arm) == 1 else None for arm in map(set, arms)]
    labels = []
    for name, (label, _), kind in zip(names, groups, unique.values(), strict=True):
        labels.append(", ".join([name or label, *kind[_MADE]]))
    return [(label, mine) for label, (_, mine) in zip(labels, groups, strict=True)]


def _check_copies(runs: Sequence[Run]) -> None:
    """Raise BidexError for a run and its copy, whatever seed the copy's config says: their times are equal."""
    known: dict[tuple[float, ...], Path] = {}
    for run in runs:
        times = tuple(row["time"] for row in run.metrics() if row.get("time") is not None)
        if len({*times}) > 1 and known.setdefault(times, run.path) != run.path:
            raise BidexError(f"{run.path} is a copy of {known[times]}: one run is not two seeds. Name it once.")


def estimates(groups: Sequence[Group]) -> dict[str, list[tuple[str, float, Interval | None]]]:
    """Return the content of a picture of groups: per title the label, interquartile mean and interval of each group."""
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
    """Return the difference in success from the first group; None for the first group and for other classes."""
    if not _comparable(group, first):
        return None
    return iqm_difference(group.success, first.success)


def score_over(group: Group, first: Group) -> Estimate | None:
    """Return the difference in normalised score as :func:`success_over`; None also if either score is unknown."""
    if not _comparable(group, first) or group.scores is None or first.scores is None:
        return None
    return iqm_difference(group.scores, first.scores)


def _comparable(group: Group, first: Group) -> bool:
    return group is not first and set(group.classes) == set(first.classes)


def scored_classes(run: Run) -> dict[str, ClassSummary]:
    """Return the ``results`` of the run's evaluation, with scores by the present references."""
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
    """Evaluated runs that the caller takes as seeds of one group; errors as of :func:`read_groups`."""
    by_seed: dict[int, dict[str, ClassSummary]] = {}
    seconds = defaultdict[int, float](float)
    steps = defaultdict[int, int](int)
    for run in runs:
        seed = run.config().seed
        goal = run.goal
        own = scored_classes(run)
        evaluated = run.evaluation().steps
        if evaluated is not None and evaluated < goal:
            raise BidexError(
                f"The evaluation of {run.path} is of {evaluated:,} steps, but the run goes on to {goal:,}. Let it end, "
                f"or write it anew: {run.again}"
            )
        of_seed = by_seed.setdefault(seed, {})
        if twice := of_seed.keys() & own.keys():
            raise BidexError(f"{run.path} is the second run of {label} with seed {seed} on {min(twice)}.")
        of_seed |= own
        seconds[seed] += training_seconds(run.metrics())
        steps[seed] += goal
    seeds = sorted(by_seed)
    classes = list(by_seed[next(iter(by_seed))])
    for seed in seeds:
        if set(by_seed[seed]) != set(classes):
            raise BidexError(
                f"Expected the same classes from every seed of {label}, but seed {seeds[0]} has {', '.join(classes)} "
                f"and seed {seed} {', '.join(by_seed[seed])}. Leave out what is not complete."
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
    """Runs that differ in the seed alone."""

    label: str  # as of :class:`Group`
    runs: list[Run]
    curves: dict[str, Curve]  # of each tag that a run has logged


def read_histories(runs: Sequence[Run]) -> list[History]:
    """Runs, evaluated or not, by group, in the order they are named; raises BidexError where none logged anything."""
    groups = _by_kind([run_kind(run.config()) for run in runs], runs)
    histories = [History(label, members, curves_of(members)) for label, members in groups]
    if not any(history.curves for history in histories):
        raise BidexError(f"{runs[0].path} holds nothing yet: nothing to draw. Let the run go on.")
    return histories


def curves_of(runs: Sequence[Run]) -> dict[str, Curve]:
    """Of each tag that one of the runs has logged: see :func:`over_runs`."""
    logged = [run.metrics() for run in runs]
    tags = dict.fromkeys(tag for rows in logged for row in rows for tag in row if tag not in ("step", "time"))
    curves = {tag: over_runs([series(rows, tag) for rows in logged]) for tag in tags}
    return {tag: curve for tag, curve in curves.items() if curve is not None}


def over_runs(series: Sequence[tuple[np.ndarray, np.ndarray]]) -> Curve | None:
    """Return mean and 95 % bootstrap interval over runs of their steps and values (points,); None without any point.

    Several are interpolated to 200 steps between the last of their first points and the first of their last ones, so
    that each point is of all runs; a run without a point is left out.
    """
    known = [(steps, values) for steps, values in series if len(steps)]
    if not known:
        return None
    if len(known) == 1:
        return Curve(*known[0], None, None)
    last = min(steps[-1] for steps, _ in known)
    first = min(last, max(steps[0] for steps, _ in known))  # they may have no step in common
    grid = np.unique(np.linspace(first, last, _POINTS))
    table = np.array([np.interp(grid, steps, values) for steps, values in known])
    low, high = bootstrap_band(table)
    return Curve(grid, table.mean(axis=0), low, high)


def series(rows: list[Json], tag: str) -> tuple[np.ndarray, np.ndarray]:
    """Return steps and values (points,) of a tag in those rows of a run's metrics that have it."""
    points = [(row["step"], row[tag]) for row in rows if row.get(tag) is not None]
    steps, values = zip(*points, strict=True) if points else ((), ())
    return np.array(steps, float), np.array(values, float)

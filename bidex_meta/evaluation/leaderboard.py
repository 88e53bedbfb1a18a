"""The leaderboard: one file per entry in one schema, and the statistics that rank entries.

Interquartile mean, performance profile and probability of improvement are those of Agarwal et al. 2021 (arXiv
2108.13264). Intervals resample seeds, and the tasks of each class. So a single seed has an interval too.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.results import Evaluation
from bidex_meta.evaluation.statistics import (
    Estimate,
    crossed_estimate,
    iqm,
    probability_of_improvement,
    share_above,
)
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.evaluations import Aggregate, MetaTestEvaluation, parse_evaluation
from bidex_meta.suite import METAWORLD_SUITES, load_suite, suite_names
from bidex_meta.utils.files import portable, read_json
from bidex_meta.utils.validation import Count, Few, Fraction, NonNegative, Seed, Whole, parse

PROFILE = (0.1, 0.5, 0.9)  # Success rates at which a performance profile is read.
FORMAT = 2
_TASKS_OF_METAWORLD = 50
_ROUNDING = 1e-4  # of stored rates
_USUAL_WIDTH = 1.96  # standard deviations of half an interval of 95 %
_NO_MEAN = Aggregate(np.inf, None, np.inf)
_Interval = tuple[Fraction, Fraction]
_Name = Annotated[str, Meta(min_length=1, max_length=100, pattern=r"^[^\x00-\x1f|]*$")]
_Digest = Annotated[str, Meta(pattern=r"^[0-9a-f]{32}$")]
_Commit = Annotated[str, Meta(pattern=r"^[0-9a-f]{7,40}\+?$")]
_Physics = Annotated[str, Meta(pattern=r"^[0-9a-f]{12}$")]
_Version = Annotated[str, Meta(max_length=100, pattern=r"^[0-9][\w.+]*$")]


@dataclass(frozen=True)
class ClassRow:
    """The results of a class in an entry."""

    success: Fraction
    interval: _Interval | None  # 95 %, of the mean over seeds and tasks; None with a single value
    tasks: Annotated[list[Annotated[list[Fraction], Meta(min_length=1)]], Meta(min_length=1)]
    """Success in each task, one list per seed."""


Classes = Annotated[dict[str, ClassRow], Meta(min_length=1)]


@dataclass(frozen=True)
class Conditions:
    """Conditions in which ``submit`` has played an entry's episodes."""

    device: _Name
    engine: Literal["auto", "c", "warp"]
    threads: Count | None
    num_envs: Count | None
    packages: dict[str, _Version | None]
    physics: _Physics | None
    suite_version: Whole | None
    suite_digest: _Physics | None = None


@dataclass(frozen=True)
class Stated:
    """Statements of the run folders that nobody can verify; lists have one item per run."""

    seeds: list[Seed]
    hours: list[NonNegative]  # of training, without evaluation
    device: _Name  # that trained
    commit: list[_Commit | None]  # that trained; + if files differed from the commit


@dataclass(frozen=True)
class Entry:
    """Runs that differ only in the seed, and their verified results; lists have one item per run."""

    format: Annotated[int, Meta(ge=FORMAT, le=FORMAT)]
    name: _Name
    suite: _Name
    version: Whole | None  # of the suite's file
    algorithm: _Name
    weights: Annotated[list[_Digest | None], Meta(min_length=1)]
    """Digests of the policies, see ``weights_digest``; None for a run whose checkpoint was not kept."""
    steps: list[Count]  # of the checkpoints
    episodes: Few  # of each task
    own: Classes  # results on the suite's own tasks
    others: Classes  # on as many tasks of each class that no run trained on
    verified: Conditions
    stated: Stated

    def success(self, classes: Classes) -> list[np.ndarray]:
        """Return the success in each class's tasks, (seeds, tasks)."""
        return [np.array(row.tasks) for row in classes.values()]


Track = Literal["reward-only", "privileged"]
"""The training of an agent that adapts: rewards of its own episodes alone; or also teachers, hidden parts of tasks, or
rewards of other goals."""


@dataclass(frozen=True)
class TrialEntry:
    """A meta-test that was played elsewhere, in ``trials/`` of the folder of entries. Nothing in it is verified."""

    format: Annotated[int, Meta(ge=FORMAT, le=FORMAT)]
    name: _Name
    track: Track
    evaluation: MetaTestEvaluation


def entry_name(suite: str, name: str) -> str:
    """Return the name of an entry's file."""
    return f"{suite}-{name}.json".replace(" ", "-").replace("/", "-")


def read_entry(path: Path) -> Entry:
    """Read an entry; raise BidexError if the file cannot be read, does not fit the schema, or contradicts itself."""
    content = read_json(path, "an entry of the leaderboard")
    entry = parse(content, Entry, str(path), exact=True)
    if portable(content) != content:
        raise BidexError(f"{path}: expected no path of a machine. Submit it again.")
    for fault in _faults(entry, path):
        raise BidexError(f"{path}: {fault}. Submit it anew.")
    return entry


def read_trial_entry(path: Path) -> TrialEntry:
    """Read an entry of an agent; raise BidexError as :func:`read_entry` does."""
    content = read_json(path, "an entry of the leaderboard")
    entry = parse(content, TrialEntry, str(path))
    if portable(content) != content:
        raise BidexError(f"{path}: expected no path of a machine. Submit it again.")
    parse_evaluation(content["evaluation"], f"{path}: evaluation")
    check_trials(entry.evaluation, str(path))
    if path.name != entry_name(entry.evaluation.suite or "", entry.name):
        raise BidexError(f"{path}: expected a file named SUITE-NAME.json of its entries. Submit it again.")
    return entry


def check_trials(evaluation: MetaTestEvaluation, where: str) -> None:
    """Raise BidexError, which begins with ``where``, for a meta-test that the leaderboard does not take."""
    again = 'Write it by meta_test(agent, "SUITE").save(FILE).'
    if evaluation.agent is None or evaluation.suite is None:
        raise BidexError(f"{where}: expected a meta-test of an agent that is no run, got no agent or suite. {again}")
    if evaluation.suite not in suite_names():
        raise BidexError(f"{where}: expected a shipped suite, got {evaluation.suite}: nobody else can play it.")
    suite = load_suite(evaluation.suite)
    if evaluation.conditions.suite_digest != suite.digest or evaluation.randomisation is not None:
        raise BidexError(f"{where}: expected {suite.name} as it is here, without randomisation, got another. {again}")
    test = evaluation.splits.get("test")
    if test is None or len(test.by_shot) != 3 or not test.rewards_shown:
        raise BidexError(f"{where}: expected test tasks after 0, 1 and 2 shots, with rewards shown. {again}")
    names = {entry.name for entry in suite.split_classes("test")}
    for shot in test.by_shot:
        rates = [row.success for row in shot.classes.values()]
        mean = ((shot.aggregate or {}).get("success") or _NO_MEAN).mean
        if shot.classes.keys() != names or max(rates) > 1.0 or min(rates) < 0.0:
            raise BidexError(f"{where}: expected success in [0, 1] of {', '.join(sorted(names))}. {again}")
        if abs(mean - np.mean(rates)) > _ROUNDING:
            raise BidexError(
                f"{where}: expected the mean of its classes, {np.mean(rates):.4f}, got {mean:.4f}. {again}"
            )


def check_apart(entries: Mapping[Path, Entry]) -> None:
    """Raise BidexError if one policy is in two entries."""
    known: dict[str, Path] = {}
    for path, entry in entries.items():
        for digest in filter(None, entry.weights):
            if digest in known:
                raise BidexError(f"{path} has a run of {known[digest]}: their weights are equal. Keep one of them.")
            known[digest] = path


def _faults(entry: Entry, path: Path) -> Iterator[str]:
    """Yield the contradictions within an entry."""
    runs = len(entry.weights)
    stated = entry.stated
    if path.name != entry_name(entry.suite, entry.name):
        yield f"expected a file named {entry_name(entry.suite, entry.name)}"
    for name, values in (("steps", entry.steps), *vars(stated).items()):
        if isinstance(values, list) and len(values) != runs:
            yield f"{name}: expected {runs} values, as many as weights, got {len(values)}"
    digests = [digest for digest in entry.weights if digest is not None]
    if len({*digests}) < len(digests):
        yield "weights: expected another policy of each run, got one twice"
    if len({*stated.seeds}) < len(stated.seeds):
        yield "stated.seeds: expected each seed once"
    if entry.version != entry.verified.suite_version:
        yield f"version: expected {entry.verified.suite_version} as in verified, got {entry.version}"
    if missing := {"bidex-meta", "mujoco"} - entry.verified.packages.keys():
        yield f"verified.packages: expected {min(missing)} to be there"
    tasks = tasks_of_suite(entry.suite, entry.version)
    for part, classes in (("own", entry.own), ("others", entry.others)):
        names = list(tasks if tasks is not None else entry.own)
        if list(classes) != names:
            yield f"{part}: expected the classes {', '.join(names)}, got {', '.join(classes)}"
        for name, row in classes.items():
            where = f"{part}.{name}"
            if tasks is None:
                wanted = len(entry.own[name].tasks[0])
            else:
                wanted = tasks[name]
            yield from (f"{where}.{fault}" for fault in _faults_of(row, runs, wanted, entry.episodes))


def _faults_of(row: ClassRow, runs: int, tasks: int, episodes: int) -> Iterator[str]:
    """Yield the contradictions within a class of ``runs`` runs and ``tasks`` tasks."""
    counts = [len(of_run) for of_run in row.tasks]
    if counts != [tasks] * runs:
        yield f"tasks: expected {tasks} values of each of {runs} runs, got {counts}"
        return
    rates = np.array(row.tasks)
    successes = rates * episodes
    if np.abs(successes - successes.round()).max() > _ROUNDING * episodes:
        yield f"tasks: expected shares of {episodes} episodes"
    mean = rates.mean()
    if abs(mean - row.success) > _ROUNDING:
        yield f"success: expected the mean of its tasks, {mean:.4f}, got {row.success:.4f}"
    if (row.interval is None) != (rates.size < 2):
        yield f"interval: expected {'none' if rates.size < 2 else 'one'} of {rates.size} values"
    elif row.interval is not None:
        low, high = row.interval
        usual = _USUAL_WIDTH * _deviation(rates)
        if not low - _ROUNDING <= mean <= high + _ROUNDING:
            yield f"interval: expected one that holds {mean:.4f}, got {low:.4f} to {high:.4f}"
        elif abs((high - low) / 2 - usual) > 0.1 * usual + 1.0 / rates.size:
            yield f"interval: expected about {mean:.3f} ± {usual:.3f}, got {low:.4f} to {high:.4f}"


def _deviation(rates: np.ndarray) -> float:
    """Return the standard deviation of the mean of rates (seeds, tasks) if both seeds and tasks are resampled."""
    seeds = rates.mean(axis=1, keepdims=True)
    tasks = rates.mean(axis=0, keepdims=True)
    rest = rates - seeds - tasks + rates.mean()
    return float(np.sqrt(seeds.var() / len(rates) + tasks.var() / rates.shape[1] + rest.var() / rates.size))


def tasks_of_suite(name: str, version: int | None) -> dict[str, int] | None:
    """Return the number of train tasks of each class; None for a suite that is not shipped in this version."""
    if name in METAWORLD_SUITES:
        return dict.fromkeys(METAWORLD_SUITES[name], _TASKS_OF_METAWORLD)
    if name not in suite_names():
        return None
    suite = load_suite(name)
    if suite.version != version:
        return None
    counts = {}
    for suite_class in suite.split_classes("train"):
        listed = sum(task.of("train") for task in suite_class.tasks)
        counts[suite_class.name] = listed or suite.drawn_tasks("train")
    return counts


def class_rows(evaluations: Sequence[Evaluation]) -> Json:
    """Return the classes of an entry from one evaluation per seed, ready for JSON."""
    rows = {}
    for name in evaluations[0].classes:
        results = [evaluation.classes[name] for evaluation in evaluations]
        tasks = np.array([result.task_means(result.successes) for result in results])
        mean = crossed_estimate(lambda tables: tables[0].mean(), [tasks])
        rows[name] = {"success": mean.value, "interval": mean.interval, "tasks": tasks.round(4).tolist()}
    return rows


def success_iqm(tables: Sequence[np.ndarray]) -> Estimate:
    """Return the interquartile mean of success over seeds and classes of tables (seeds, tasks), one per class."""
    return crossed_estimate(lambda tables: float(iqm(success_rates(tables).ravel())), tables)


def profile(tables: Sequence[np.ndarray], rate: float) -> float:
    """Return the share of seeds and classes that succeed in more than ``rate`` of their tasks."""
    return share_above(success_rates(tables), rate)


def improvement(a: Sequence[np.ndarray], b: Sequence[np.ndarray]) -> Estimate:
    """Return the probability that a seed of ``a`` has more success in a class than a seed of ``b``."""
    return crossed_estimate(lambda a, b: probability_of_improvement(success_rates(a), success_rates(b)), a, b)


def success_rates(tables: Sequence[np.ndarray]) -> np.ndarray:
    """Return success rates (seeds, classes)."""
    return np.stack([table.mean(axis=1) for table in tables], axis=1)

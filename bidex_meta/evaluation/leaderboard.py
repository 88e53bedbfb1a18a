"""The leaderboard: results of runs in one schema, a file an entry, and the statistics that rank them.

Interquartile mean, performance profile and probability of improvement are those of Agarwal et al. 2021 (arXiv
2108.13264). Intervals resample seeds, and within each class the tasks, so that a single seed has one too: of its tasks.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.results import Evaluation
from bidex_meta.evaluation.statistics import BOOTSTRAP_SEED, RESAMPLES, Estimate, interquartile_mean
from bidex_meta.runs.atomic import Json
from bidex_meta.utils.files import read_json
from bidex_meta.utils.validation import Fraction, NonNegative, Seed, Text, Whole, parse

PROFILE = (0.1, 0.5, 0.9)
"""Success rates at which a performance profile is read."""
_Interval = tuple[Fraction, Fraction]


@dataclass(frozen=True)
class ClassRow:
    """A class of an entry; interval: 95 %, of the mean over seeds and tasks, None of a single sample."""

    success: Fraction
    interval: _Interval | None
    tasks: Annotated[list[Annotated[list[Fraction], Meta(min_length=1)]], Meta(min_length=1)]
    """Success in each task, a list for each seed."""


Classes = Annotated[dict[str, ClassRow], Meta(min_length=1)]


@dataclass(frozen=True)
class Entry:
    """Runs that differ in nothing but the seed, as they were played to verify them; lists have an item a seed."""

    format: Annotated[int, Meta(ge=1, le=1)]
    name: Text
    suite: Text
    version: Whole | None  # of the suite's file
    algorithm: Text
    seeds: list[Seed]
    steps: list[Whole]
    hours: list[NonNegative]  # of training, without evaluation
    device: Text  # that trained
    commit: list[Text | None]  # that trained; with + where files differed from it
    episodes: Whole  # of each task
    own: Classes  # results on the suite's own tasks
    others: Classes  # on as many tasks of each class that no run trained on
    verified: Json  # conditions of the evaluation: packages, device, physics

    def success(self, classes: Classes) -> list[np.ndarray]:
        """Success of each class's tasks, (seeds, tasks)."""
        return [np.array(row.tasks) for row in classes.values()]


def read_entry(path: Path) -> Entry:
    """An entry's file; raises BidexError where it cannot be read or does not fit the schema."""
    entry = parse(read_json(path, "an entry of the leaderboard"), Entry, str(path), exact=True)
    shapes = {(name, len(row.tasks)) for part in (entry.own, entry.others) for name, row in part.items()}
    if entry.own.keys() != entry.others.keys() or {count for _, count in shapes} != {len(entry.seeds)}:
        raise BidexError(f"{path}: expected the same classes twice, of {len(entry.seeds)} seeds. Submit it anew.")
    return entry


def class_rows(evaluations: Sequence[Evaluation]) -> Json:
    """The classes of an entry from an evaluation of each seed, ready for JSON."""
    rows = {}
    for name in evaluations[0].classes:
        found = [evaluation.classes[name] for evaluation in evaluations]
        tasks = np.array(
            [[each.successes[each.tasks == task].mean() for task in np.unique(each.tasks)] for each in found]
        )
        mean = estimate(lambda classes: classes[0].mean(), [tasks])
        rows[name] = {"success": mean.value, "interval": mean.interval, "tasks": tasks.round(4).tolist()}
    return rows


def iqm(classes: Sequence[np.ndarray]) -> float:
    """Interquartile mean over seeds and classes, whose tasks are (seeds, tasks)."""
    return interquartile_mean(_rates(classes))


def profile(classes: Sequence[np.ndarray], rate: float) -> float:
    """Share of seeds and classes that succeed in more than ``rate`` of their tasks."""
    return float((_rates(classes) > rate).mean())


def improvement(a: Sequence[np.ndarray], b: Sequence[np.ndarray]) -> float:
    """Probability that a seed of ``a`` has more success than one of ``b`` in a class, a tie counting half."""
    gaps = _rates(a)[:, None] - _rates(b)[None]
    return float((0.5 + 0.5 * np.sign(gaps)).mean())


def estimate(statistic: Callable[..., float], *entries: Sequence[np.ndarray]) -> Estimate:
    """A statistic of entries (each its classes, as above) and its 95 % bootstrap interval, equal for equal input."""
    value = float(statistic(*entries))
    if max(array.size for classes in entries for array in classes) < 2:
        return Estimate(value, None)
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    found = [statistic(*(_resampled(classes, rng) for classes in entries)) for _ in range(RESAMPLES)]
    low, high = np.percentile(found, (2.5, 97.5))
    return Estimate(value, (float(low), float(high)))


def _resampled(classes: Sequence[np.ndarray], rng: np.random.Generator) -> list[np.ndarray]:
    """All classes of a seed stay together: they come from one run."""
    seeds = rng.integers(len(classes[0]), size=len(classes[0]))
    return [array[seeds][:, rng.integers(array.shape[1], size=array.shape[1])] for array in classes]


def _rates(classes: Sequence[np.ndarray]) -> np.ndarray:
    """Success rates, (seeds, classes)."""
    return np.stack([array.mean(axis=1) for array in classes], axis=1)

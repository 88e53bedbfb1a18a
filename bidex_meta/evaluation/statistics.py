"""Bootstrap intervals, interquartile means, paired differences and the probability of improvement.

Interquartile mean, performance profile and probability of improvement are defined as in Agarwal et al. 2021 (arXiv
2108.13264). Every interval of the package is a 95 % percentile bootstrap interval from :func:`bootstrap`, and equal
input gives an equal interval.
"""

from collections.abc import Callable, Sequence
from itertools import chain

import numpy as np

from bidex_meta.runs.evaluations import Aggregate, Estimate, Interval

Statistic = Callable[..., np.ndarray]
"""Maps one array of shape ``(resamples, n, ...)`` per sample to values of shape ``(resamples,)``."""

NONE = "–"
"""Text in tables for a missing value."""


RESAMPLES = 2000
BOOTSTRAP_SEED = 0
_BATCH = 200  # Drawing every resample at once would need 2000 times the memory of the sample.
_TAIL = (1.0 - 0.95) / 2


def generator_of_resamples() -> np.random.Generator:
    """Return a generator in the state from which every bootstrap starts."""
    return np.random.default_rng(BOOTSTRAP_SEED)


def bootstrap(
    statistic: Callable[..., np.ndarray],
    levels: Sequence[tuple[int, ...]],
    generator: np.random.Generator | None = None,
    batch: int = _BATCH,
) -> np.ndarray:
    """Return ``statistic`` for each of ``RESAMPLES`` resamples, shape ``(RESAMPLES, ...)``.

    A level ``(a, b, n)`` draws n out of n units with replacement, separately within each of the a x b groups. For
    example, runs that contain tasks that contain episodes are the levels ``(runs,)``, ``(runs, tasks)``, ``(runs,
    tasks, episodes)``. Units without a level, for example the classes of a suite, are not resampled.

    Args:
        statistic: Takes the drawn indices of each level, int64 ``(resamples, *level)``, and returns one value or one
            array per resample.
        levels: The levels in the order in which they are drawn.
        generator: Draws the indices. Default: a new one, seeded with ``BOOTSTRAP_SEED``.
        batch: Number of resamples that are drawn at a time. It bounds memory, and it determines the draws if there
            are several levels.
    """
    generator = generator or generator_of_resamples()
    values = []
    for first in range(0, RESAMPLES, batch):
        size = min(batch, RESAMPLES - first)
        indices = [generator.integers(level[-1], size=(size, *level)) for level in levels]
        values.append(statistic(*indices))
    return np.concatenate(values)


def percentile_interval(resampled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the 2.5 % and 97.5 % quantiles of resampled values ``(resamples, ...)``, each of shape ``(...)``.

    Quantiles are interpolated linearly between order statistics.
    """
    ordered = np.sort(resampled, axis=0)
    return _quantile(ordered, _TAIL), _quantile(ordered, 1.0 - _TAIL)


def _quantile(ordered: np.ndarray, share: float) -> np.ndarray:
    # This is the arithmetic of scipy.stats.quantile, which computed the stored intervals; np.quantile rounds
    # differently.
    position = share * len(ordered) + (1.0 - share)
    weight = position % 1
    below = int(position) - 1
    above = min(below + 1, len(ordered) - 1)
    return (1.0 - weight) * ordered[below] + weight * ordered[above]


def interval_of(resampled: np.ndarray) -> Interval:
    """Return the 95 % interval of resampled values ``(resamples,)``."""
    low, high = percentile_interval(resampled)
    return float(low), float(high)


def estimate(statistic: Statistic, *samples: np.ndarray) -> Estimate:
    """Return ``statistic`` of independent samples ``(n, ...)``, with an interval over the n entries of each sample.

    The interval is None if a sample has fewer than two entries.
    """
    value = float(statistic(*(sample[None] for sample in samples))[0])
    if min(len(sample) for sample in samples) < 2:
        return Estimate(value, None)

    def resampled(*indices: np.ndarray) -> np.ndarray:
        return statistic(*(sample[index] for sample, index in zip(samples, indices, strict=True)))

    return Estimate(value, interval_of(bootstrap(resampled, [(len(sample),) for sample in samples])))


def mean(sample: np.ndarray) -> np.ndarray:
    """Return the mean of each resample in ``sample`` ``(resamples, n)``.

    This function can be the ``statistic`` of :func:`estimate`.
    """
    return sample.mean(axis=-1)


def mean_difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the mean of ``a`` minus the mean of ``b`` for each resample.

    This function can be the ``statistic`` of :func:`estimate`.
    """
    return mean(a) - mean(b)


def mean_of_means(*samples: np.ndarray) -> np.ndarray:
    """Return, for each resample, the unweighted average of the means of all samples, each ``(resamples, n)``.

    This function can be the ``statistic`` of :func:`estimate`.
    """
    return np.asarray(sum(mean(sample) for sample in samples) / len(samples))


def iqm(values: np.ndarray) -> np.ndarray:
    """Return the interquartile mean over the last axis, shape ``(...)`` for values ``(..., n)``.

    The n // 4 lowest and the n // 4 highest values are left out.
    """
    size = values.shape[-1]
    cut = size // 4
    ordered = np.partition(values, (cut, size - cut - 1), axis=-1)
    return ordered[..., cut : size - cut].mean(axis=-1)


def iqm_over_seeds(values: np.ndarray) -> Estimate:
    """Return the interquartile mean over seeds and classes of ``values`` (seeds, classes), with an interval over seeds.

    All classes of a seed are resampled together because they come from one run.
    """
    return estimate(_iqm_of_tables, values)


def iqm_difference(a: np.ndarray, b: np.ndarray) -> Estimate:
    """Return the interquartile mean of ``a`` minus that of ``b``, with an interval over the seeds of both.

    Both arrays have the shape (seeds, classes).
    """
    return estimate(lambda a, b: _iqm_of_tables(a) - _iqm_of_tables(b), a, b)


def _iqm_of_tables(values: np.ndarray) -> np.ndarray:
    return iqm(values.reshape(len(values), -1))


def aggregate(samples: Sequence[np.ndarray | None]) -> Aggregate | None:
    """Return the mean over classes of the class means, with interval and interquartile mean.

    Args:
        samples: One sample ``(n,)`` per class, of tasks or episodes (``ClassResult.drawn``). If one of them is None the
            result is None, because a mean over some classes could be mistaken for a mean over all.
    """
    known = [sample for sample in samples if sample is not None]
    if not known or len(known) < len(samples):
        return None
    means = np.array([sample.mean() for sample in known])
    interval = estimate(mean_of_means, *known).interval
    return Aggregate(float(means.mean()), interval, float(iqm(means)))


def resampled_means(values: np.ndarray, generator: np.random.Generator | None = None) -> np.ndarray | None:
    """Return means ``(RESAMPLES,)`` of values (runs, groups, episodes), all three levels resampled.

    The result is None with fewer than two values. ``generator`` is that of :func:`bootstrap`.
    """
    if values.size < 2:
        return None

    def means(run: np.ndarray, group: np.ndarray, episode: np.ndarray) -> np.ndarray:
        return values[run[..., None, None], group[..., None], episode].mean(axis=(1, 2, 3))

    levels = [values.shape[: depth + 1] for depth in range(values.ndim)]
    return bootstrap(means, levels, generator)


def paired_difference(differences: np.ndarray) -> Estimate:
    """Return the mean of paired differences (runs, groups, episodes), with an interval over all three levels."""
    return estimate_from(float(differences.mean()), resampled_means(differences))


def estimate_from(value: float, resampled: np.ndarray | None) -> Estimate:
    """Return a value with the 95 % interval of its resamples ``(resamples,)``; None gives no interval."""
    return Estimate(value, None if resampled is None else interval_of(resampled))


def bootstrap_band(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the interval of the mean over runs at each point, lower and upper ends ``(points,)``.

    ``values`` (runs, points) holds at least two runs. The runs of all points are resampled together.
    """
    runs = len(values)

    def means(indices: np.ndarray) -> np.ndarray:
        counts = np.stack([np.bincount(chosen, minlength=runs) for chosen in indices])
        return counts / runs @ values

    return percentile_interval(bootstrap(means, [(runs,)], batch=RESAMPLES))


def crossed_estimate(statistic: Callable[..., float], *entries: Sequence[np.ndarray]) -> Estimate:
    """Return ``statistic(*entries)``, with a bootstrap interval over seeds and over the tasks of each class.

    An entry is a list with one table (seeds, tasks) per class, for example the results of one learner. A seed stands
    for one run over all classes, so seeds are resampled for all tables of an entry together. All seeds play the same
    tasks of a class, so tasks are resampled for all seeds together. The interval is None if every table has only one
    value.
    """
    value = float(statistic(*entries))
    if all(table.size < 2 for table in chain.from_iterable(entries)):
        return Estimate(value, None)
    levels = []
    for entry in entries:
        levels.append((len(entry[0]),))
        levels.extend((table.shape[1],) for table in entry)

    def resampled(*indices: np.ndarray) -> np.ndarray:
        drawn = iter(indices)
        chosen = []
        for entry in entries:
            seeds = next(drawn)[0]
            chosen.append([table[seeds][:, next(drawn)[0]] for table in entry])
        return np.array([statistic(*chosen)])

    # The tables of an entry differ in size, so a batch is a single resample.
    return estimate_from(value, bootstrap(resampled, levels, batch=1))


def probability_of_improvement(a: np.ndarray, b: np.ndarray) -> float:
    """Return the probability that a seed of ``a`` exceeds a seed of ``b`` in a class; a tie counts one half.

    ``a`` and ``b`` are (seeds, classes) with the same classes.
    """
    gaps = a[:, None] - b[None]
    return float((0.5 + 0.5 * np.sign(gaps)).mean())


def share_above(values: np.ndarray, threshold: float) -> float:
    """Return the share of values above ``threshold``, a point of a performance profile."""
    return float((values > threshold).mean())

"""Means with bootstrap intervals."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bidex_meta.runs.atomic import Json

Statistic = Callable[..., Any]  # of samples, along ``axis``
Interval = tuple[float, float]  # lower and upper end of a 95 % bootstrap interval


@dataclass(frozen=True)
class Estimate:
    """A number with its uncertainty."""

    value: float
    interval: Interval | None  # 95 % bootstrap interval; None with fewer than two samples

    @property
    def excludes_zero(self) -> bool:
        """Whether the interval lies on one side of zero."""
        return self.interval is not None and (self.interval[0] > 0 or self.interval[1] < 0)

    def text(self, factor: float = 1.0, unit: str = "", form: str = ".1f") -> str:
        """The number times ``factor``, and its interval in brackets where there is one."""
        ends = "" if self.interval is None else f" [{', '.join(f'{factor * end:{form}}' for end in self.interval)}]"
        return f"{factor * self.value:{form}}{unit}{ends}"


RESAMPLES = 2000
BOOTSTRAP_SEED = 0


def aggregate(samples: list[np.ndarray | None]) -> Json | None:
    """Mean and interquartile mean over classes of the classes' means, the mean with a bootstrap interval.

    Samples are those of each class, tasks or episodes (``ClassResult.drawn``); None in any of them gives None, since a
    mean over some of the classes would pass for one over all.
    """
    known = [sample for sample in samples if sample is not None]
    if not known or len(known) < len(samples):
        return None
    means = np.array([sample.mean() for sample in known])
    interval = bootstrap_interval(_mean_of_means, *known)
    return {"mean": float(means.mean()), "interval": interval, "iqm": interquartile_mean(means)}


def interquartile_mean(values: np.ndarray) -> float:
    """The mean without the lowest and the highest quarter of ``values``, any shape."""
    cut = values.size // 4
    return float(np.partition(values.ravel(), (cut, values.size - cut - 1))[cut : values.size - cut].mean())


def bootstrap_interval(statistic: Statistic, *samples: np.ndarray) -> Interval | None:
    """The 95 % percentile bootstrap interval of ``statistic``, each sample (n,) resampled by itself.

    The same for the same input; None where a sample has fewer than two entries.
    """
    if min(len(sample) for sample in samples) < 2:
        return None
    from scipy.stats import bootstrap

    result = bootstrap(
        samples,
        statistic,
        n_resamples=RESAMPLES,
        batch=200,  # bounds memory: all resamples at once would be 2000 times the episodes
        vectorized=True,
        method="percentile",
        rng=np.random.default_rng(BOOTSTRAP_SEED),
    )
    return float(result.confidence_interval.low), float(result.confidence_interval.high)


def bootstrap_band(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The 95 % percentile bootstrap interval of the mean over rows, of many columns at once, the same for equal input.

    Of ``values`` (runs, points), at least two runs, the runs of all points are resampled together. Returns lower and
    upper ends, each ``(points,)``.
    """
    chosen = np.random.default_rng(BOOTSTRAP_SEED).integers(len(values), size=(RESAMPLES, len(values)))
    weights = np.stack([np.bincount(rows, minlength=len(values)) for rows in chosen]) / len(values)
    low, high = np.percentile(weights @ values, (2.5, 97.5), axis=0)
    return low, high


def mean(sample: np.ndarray, axis: int = -1) -> np.ndarray:
    """The mean along ``axis``, as a statistic of ``bootstrap_interval``."""
    return np.mean(sample, axis=axis)


def mean_difference(a: np.ndarray, b: np.ndarray, axis: int = -1) -> np.ndarray:
    """The mean of ``a`` minus that of ``b`` along ``axis``, likewise."""
    return np.mean(a, axis=axis) - np.mean(b, axis=axis)


def _mean_of_means(*samples: np.ndarray, axis: int = -1) -> np.ndarray:
    return np.asarray(sum(np.mean(sample, axis=axis) for sample in samples) / len(samples))

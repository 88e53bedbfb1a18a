"""A metric over training."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Curve:
    """A metric against environment steps; arrays (points,)."""

    steps: np.ndarray
    """Environment steps, rising."""
    mean: np.ndarray
    """The metric, over several runs their mean."""
    low: np.ndarray | None
    """Lower end of the interval over runs; None of a single run."""
    high: np.ndarray | None
    """Upper end."""

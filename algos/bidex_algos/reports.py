"""Metrics on their way to the log."""

import math
from collections.abc import Iterable

import torch
from torch import Tensor


def as_numbers(tensors: dict[str, Tensor]) -> dict[str, float]:
    """Scalars as numbers, in one transfer from the device."""
    if not tensors:
        return {}
    values = torch.stack([value.double() for value in tensors.values()]).tolist()
    return dict(zip(tensors, values, strict=True))


def check_finite(metrics: dict[str, float], losses: Iterable[str], learner: str, steps: int, remedy: str) -> None:
    """Ends a training that can no longer learn.

    Raises:
        FloatingPointError: One of the ``losses`` among the metrics is not finite.
    """
    if not math.isfinite(sum(metrics.get(name, 0.0) for name in losses)):
        raise FloatingPointError(f"{learner}: the loss is not finite after {steps} steps; {remedy}.")

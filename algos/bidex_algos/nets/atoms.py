"""Distributions of returns over fixed values: C51's atoms (Bellemare et al. 2017, arXiv 1707.06887)."""

import torch
from torch import Tensor, nn


class Atoms(nn.Module):
    """Values z_0 < ... < z_{A-1}, evenly spaced, that a distribution gives probabilities to. It has no weights.

    Args:
        low: The lowest.
        high: The highest.
        count: How many, A; at least 2.
    """

    def __init__(self, low: float, high: float, count: int):
        super().__init__()
        self.low, self.high, self.count = low, high, count
        self.values: Tensor
        self.register_buffer("values", torch.linspace(low, high, count), persistent=False)

    def mean(self, probs: Tensor) -> Tensor:
        """Expected values (...) of distributions (..., A)."""
        return (probs * self.values).sum(-1)

    def projected(self, probs: Tensor, shift: Tensor, factor: Tensor) -> Tensor:
        """The distribution of shift + factor * Z on the atoms, where Z is distributed as ``probs``.

        What falls between two atoms is split between them so that its mean stays; what falls beyond the range goes to
        the atom at its end.

        Args:
            probs: Shape (B, A).
            shift: Shape (B,).
            factor: Shape (B,).

        Returns:
            Shape (B, A).
        """
        moved = shift[:, None] + factor[:, None] * self.values
        # In units of the distance of two atoms, from the lowest.
        place = (moved.clamp(self.low, self.high) - self.low) * ((self.count - 1) / (self.high - self.low))
        share = place - place.floor()
        # What is not a number shall stay so and not become a place in memory.
        index = place.long().clamp(0, self.count - 1)
        out = torch.zeros_like(probs).scatter_add_(1, index, probs * (1.0 - share))
        return out.scatter_add_(1, (index + 1).clamp_max(self.count - 1), probs * share)

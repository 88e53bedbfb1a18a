"""What a task freezes: a vector of named numbers."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class VariationSpace:
    """The box from which a class's variations are drawn uniformly.

    Component names, e.g. ``goal_x``, with their lower and upper ends; in metres, radians, or a draw in [-1, 1].
    """

    names: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        if not len(self.names) == len(self.low) == len(self.high):
            raise ValueError(f"names, low and high need one length, got {self.names}, {self.low}, {self.high}")

    @property
    def size(self) -> int:
        """Number of components."""
        return len(self.names)

    def sample(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """N variations, uniform in the box. Shape (n, size), float64."""
        return rng.uniform(self.low, self.high, size=(n, self.size))

    def contains(self, vector: np.ndarray) -> bool:
        """Whether a vector of shape (size,) lies in the box."""
        vector = np.asarray(vector)
        return vector.shape == (self.size,) and bool(np.all((vector >= self.low) & (vector <= self.high)))


def join(*parts: VariationSpace) -> VariationSpace:
    """One space of the components of several, in their order."""
    return VariationSpace(
        sum((p.names for p in parts), ()), sum((p.low for p in parts), ()), sum((p.high for p in parts), ())
    )


def component(name: str, low: float, high: float) -> VariationSpace:
    """A space of one number."""
    return VariationSpace((name,), (low,), (high,))


def box(prefix: str, centre: tuple[float, float, float], half: float) -> VariationSpace:
    """A cube of positions around a centre: components ``<prefix>_x``, ``_y``, ``_z`` in metres."""
    names = tuple(f"{prefix}_{axis}" for axis in "xyz")
    return VariationSpace(names, tuple(c - half for c in centre), tuple(c + half for c in centre))


def orientation(prefix: str) -> VariationSpace:
    """The two draws of a random orientation (docs/figures.md, start noise): ``<prefix>_u0``, ``_u1`` in [-1, 1]."""
    return VariationSpace((f"{prefix}_u0", f"{prefix}_u1"), (-1.0, -1.0), (1.0, 1.0))

"""The variation of a task: a vector of named numbers, e.g. goal coordinates, in which tasks of one class differ."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from bidex_meta.errors import BidexError
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.validation import Finite, NonNegative, Text, Whole


@checked_arguments
@dataclass(frozen=True)
class VariationSpace:
    """The box from which a class's variations are drawn uniformly.

    ``names`` are the components, e.g. ``goal_x``; ``low`` and ``high`` are their lower and upper ends. Components are
    in metres or radians, or are draws in [-1, 1].
    """

    names: tuple[Text, ...]
    low: tuple[Finite, ...]
    high: tuple[Finite, ...]

    def __post_init__(self) -> None:
        if not len(self.names) == len(self.low) == len(self.high):
            raise BidexError(
                f"Expected names, low and high of one length, got {self.names}, {self.low} and {self.high}."
            )
        if len(set(self.names)) < len(self.names):
            raise BidexError(f"VariationSpace: expected each name once, got {', '.join(self.names)}. Rename one.")
        for name, low, high in zip(self.names, self.low, self.high, strict=True):
            if low > high:
                raise BidexError(
                    f"{name}: expected its lower end before its upper end, got {low} and {high}. Swap them."
                )

    @property
    def size(self) -> int:
        """Return the number of components."""
        return len(self.names)

    @checked_arguments
    def sample(self, rng: np.random.Generator, n: Whole) -> np.ndarray:
        """Draw ``n`` variations, uniform in the box. Shape (n, size), float64."""
        return rng.uniform(self.low, self.high, size=(n, self.size))

    @checked_arguments
    def only(self, names: Collection[Text]) -> "VariationSpace":
        """Return the space of the components with these names, in the order of this space."""
        columns = [i for i, name in enumerate(self.names) if name in names]
        return VariationSpace(
            tuple(self.names[i] for i in columns),
            tuple(self.low[i] for i in columns),
            tuple(self.high[i] for i in columns),
        )

    def contains(self, vector: np.ndarray) -> bool:
        """Return whether a vector of shape (size,) lies in the box."""
        vector = np.asarray(vector)
        return vector.shape == (self.size,) and bool(np.all((vector >= self.low) & (vector <= self.high)))


NO_COMPONENTS = VariationSpace((), (), ())
"""The space without components."""


@checked_arguments
def join(*parts: VariationSpace) -> VariationSpace:
    """Return one space with the components of several spaces, in their order."""
    return VariationSpace(
        sum((p.names for p in parts), ()), sum((p.low for p in parts), ()), sum((p.high for p in parts), ())
    )


@checked_arguments
def component(name: Text, low: Finite, high: Finite) -> VariationSpace:
    """Return a space of one number."""
    return VariationSpace((name,), (low,), (high,))


@checked_arguments
def box(prefix: Text, centre: tuple[Finite, Finite, Finite], half: NonNegative) -> VariationSpace:
    """Return a cube of positions around a centre: components ``<prefix>_x``, ``_y``, ``_z`` in metres."""
    names = tuple(f"{prefix}_{axis}" for axis in "xyz")
    return VariationSpace(names, tuple(c - half for c in centre), tuple(c + half for c in centre))


@checked_arguments
def orientation(prefix: Text) -> VariationSpace:
    """Return the space of the two draws that give a random orientation: ``<prefix>_u0`` and ``_u1``, in [-1, 1].

    See docs/figures.md, start noise.
    """
    return VariationSpace((f"{prefix}_u0", f"{prefix}_u1"), (-1.0, -1.0), (1.0, 1.0))

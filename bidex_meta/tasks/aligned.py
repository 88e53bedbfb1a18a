"""The reward of version 2: one formula for all classes, based on a state's errors."""

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from bidex_meta.tasks.variation import VariationSpace


class Hidden(NamedTuple):
    """A part of a task that observations show only in goal entries; success requires each part separately."""

    names: tuple[str, ...]
    """Components of the variation: the coordinates of one point, in metres or rad, or the draws of an orientation."""
    tolerance: float
    """Distance from the goal that success allows, or the allowed angle for an orientation; infinite for a sign."""
    kind: Literal["point", "orientation", "sign"] = "point"

    def described(self, space: VariationSpace) -> str:
        """Return the components with their ranges, and the tolerance, as text."""
        ends = dict(zip(space.names, zip(space.low, space.high, strict=True), strict=True))
        ranges = ", ".join(f"{name} {ends[name][0]:.3g} … {ends[name][1]:.3g}" for name in self.names)
        if self.kind == "sign":
            return ranges
        return f"{ranges} (within {self.tolerance:.3g})"


class Error(NamedTuple):
    """One of the values that must be small for a state to be solved."""

    value: Tensor
    """The error in each environment, at least 0, shape (n,), in the unit of the tolerance."""
    tolerance: float
    """Bound of the value; in solved states the value is smaller."""


def at_least(value: Tensor, least: float, tolerance: float) -> Error:
    """Return the error of a value that must exceed ``least``; the error is zero from ``least`` + ``tolerance`` on."""
    return Error((least + tolerance - value).clamp(min=0.0), tolerance)


def within(errors: list[Error]) -> Tensor:
    """Return whether every error is below its tolerance. Shape (n,), bool."""
    return torch.stack([error.value < error.tolerance for error in errors]).all(dim=0)


def aligned_terms(solved: Tensor, errors: list[Error], guides: list[Tensor]) -> dict[str, Tensor]:
    """Return the terms (n,) of the reward of version 2, in [0, 1]: their sum is 1 if ``solved``, otherwise at most 0.9.

    The term ``solved`` is 1 or 0. If it is 1, all other terms are 0. Otherwise they depend on the class's errors e,
    divided by their tolerances: ``far`` is the mean of 1 - tanh(e / 16), and ``near`` is the mean of exp(-0.3 e). For
    an egg at distance d (m) from its goal these are 1 - tanh(2 d) and exp(-10 d). In classes with ``guides``, which are
    distances d (m) of hands from points, ``reach`` is the mean of 1 - tanh(3 d). The weights are 0.25 for far and 0.65
    for near; in classes with reach they are 0.2 for reach, 0.2 for far and 0.5 for near.
    """
    off = torch.stack([error.value / error.tolerance for error in errors])
    far = (1.0 - torch.tanh(off / 16.0)).mean(dim=0)
    near = torch.exp(-0.3 * off).mean(dim=0)
    if guides:
        reach = (1.0 - torch.tanh(3.0 * torch.stack(guides))).mean(dim=0)
        terms = {"reach": 0.2 * reach, "far": 0.2 * far, "near": 0.5 * near}
    else:
        terms = {"far": 0.25 * far, "near": 0.65 * near}
    shaped = {name: torch.where(solved, 0.0, value) for name, value in terms.items()}
    return {**shaped, "solved": solved.to(off.dtype)}

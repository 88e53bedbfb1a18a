"""Reward of version 2, which has one formula for all task classes.

The formula reads the errors of a state: values such as a distance from the goal, which must become small for success.
"""

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from bidex_meta.tasks.variation import VariationSpace


class Hidden(NamedTuple):
    """A part of a task's goal, such as a target point, that observations show only in their goal entries.

    Suites with hidden goals set the goal entries to zero. Success requires every part to be within its own tolerance.
    """

    names: tuple[str, ...]
    """Components of the variation: the coordinates of one point, in metres or rad, or the draws of an orientation."""
    tolerance: float
    """Distance from the goal that success allows, or the allowed angle for an orientation; infinite for a sign."""
    kind: Literal["point", "orientation", "sign"] = "point"

    def described(self, space: VariationSpace) -> str:
        """Return a text with the range of each component of this part, and with the part's tolerance.

        ``space`` holds the ranges. A part of the kind ``sign`` has no tolerance, so the text contains only the range.
        """
        ends = dict(zip(space.names, zip(space.low, space.high, strict=True), strict=True))
        ranges = ", ".join(f"{name} {ends[name][0]:.3g} … {ends[name][1]:.3g}" for name in self.names)
        if self.kind == "sign":
            return ranges
        return f"{ranges} (within {self.tolerance:.3g})"


class Error(NamedTuple):
    """A value, such as a distance from the goal, that must be smaller than its tolerance for success."""

    value: Tensor
    """The error in each environment, at least 0, shape (n,), in the unit of the tolerance."""
    tolerance: float
    """Bound of the value; in solved states the value is smaller."""


def at_least(value: Tensor, least: float, tolerance: float) -> Error:
    """Return the error that is below ``tolerance`` exactly when ``value`` exceeds ``least``.

    The error is max(0, ``least`` + ``tolerance`` - ``value``).
    """
    return Error((least + tolerance - value).clamp(min=0.0), tolerance)


def within(errors: list[Error]) -> Tensor:
    """Return whether every error is below its tolerance. Shape (n,), bool."""
    return torch.stack([error.value < error.tolerance for error in errors]).all(dim=0)


def aligned_terms(solved: Tensor, errors: list[Error], guides: list[Tensor]) -> dict[str, Tensor]:
    """Return the terms of version 2's reward, each (n,), in [0, 1], by name; the reward is their sum.

    If a state is ``solved``, the term ``solved`` is 1, all other terms are 0 and the reward is 1. If not, ``solved`` is
    0, and the other terms sum to at most 0.9. These other terms are weighted means, in which e is an error divided by
    its tolerance and d is a distance (m) in ``guides``:

    * ``far``: mean of 1 - tanh(e / 16) over all errors, times 0.25, or times 0.2 if there are guides.
    * ``near``: mean of exp(-0.3 e) over all errors, times 0.65, or times 0.5 if there are guides.
    * ``reach``: mean of 1 - tanh(3 d) over all guides, times 0.2; left out if there are none.

    For an egg whose goal is x metres away, the means in ``far`` and ``near`` are about 1 - tanh(2 x), and exp(-10 x).
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

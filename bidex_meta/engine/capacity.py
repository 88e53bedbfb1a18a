"""Room for contacts and constraints, which mujoco_warp allocates once and for all."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

_HEADROOM = 1.5
"""A trained policy holds what rough actions only brush against, and room is cheap: 0.10 to 0.18 MB a world in all."""


@dataclass(frozen=True)
class Capacity:
    """Room per world, or the most of it that was seen in use.

    Attributes:
        contacts: Candidate pairs of the broadphase, and contacts; all worlds share one pool of so many each.
        convex: Pairs of a kind that the convex collider (eggs, cylinders) takes on at a time; one pool too.
        rows: Constraint rows, a hard limit for each world.
    """

    contacts: int
    convex: int
    rows: int


def room_for(seen: Sequence[Capacity]) -> Capacity:
    """Room for worlds of several kinds: the most that any was seen to need, and half as much again."""
    contacts, convex, rows = (
        _HEADROOM * max(getattr(one, name) for one in seen) for name in ("contacts", "convex", "rows")
    )
    return Capacity(_up(contacts, 16), max(2, math.ceil(convex)), _up(rows, 16))


def _up(value: float, multiple: int) -> int:
    return multiple * math.ceil(value / multiple)

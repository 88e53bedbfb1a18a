"""Room for contacts and constraints, which mujoco_warp allocates once and for all."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco


@dataclass(frozen=True)
class Capacity:
    """Room per world.

    Attributes:
        contacts: Candidate pairs and contacts; all worlds share one pool of so many each.
        convex: Pairs that the convex collider measures at a time (an ellipsoid in penetration); one pool too.
        rows: Constraint rows, a hard limit for each world.
    """

    contacts: int
    convex: int
    rows: int


def capacity_of(models: Sequence[mujoco.MjModel]) -> Capacity:
    """Room."""
    return Capacity(256, 16, 512)

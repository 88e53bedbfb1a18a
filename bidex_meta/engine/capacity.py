"""Buffer sizes for contacts and constraints, which mujoco_warp allocates once at the start."""

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass

from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.validation import Whole


@checked_arguments
@dataclass(frozen=True)
class Capacity:
    """Buffer sizes per world, or the largest part of the buffers that was in use."""

    contacts: Whole  # candidate pairs of the broadphase, and contacts, per world; all worlds share one pool
    # Pairs of one kind that the convex collider (eggs, cylinders) processes at a time, in one shared pool.
    convex: Whole
    rows: Whole  # constraint rows; a hard limit for each world


def room_for(seen: Sequence[Capacity]) -> Capacity:
    """Return the buffer sizes for worlds of several kinds: 1.5 times the largest size that any kind needs.

    The margin is needed because a trained policy holds objects that random actions only touch. The buffers take little
    memory: 0.10 to 0.18 MB per world in all.
    """
    contacts, convex, rows = (1.5 * max(each) for each in zip(*map(astuple, seen), strict=True))
    return Capacity(16 * math.ceil(contacts / 16), max(2, math.ceil(convex)), 16 * math.ceil(rows / 16))

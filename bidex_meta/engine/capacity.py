"""Buffer sizes for contacts and constraints, which mujoco_warp allocates once at the start."""

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass

from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.validation import Whole


@checked_arguments
@dataclass(frozen=True)
class Capacity:
    """Sizes per world of mujoco_warp's buffers for contacts and constraints; also describes their measured peak use."""

    contacts: (
        Whole  # candidate pairs of the broadphase, and contacts; all worlds share one pool, of this number per world
    )
    convex: Whole  # pairs of one kind that the convex collider (eggs, cylinders) treats at a time; also a shared pool
    rows: Whole  # constraint rows, a hard limit for each world


def room_for(seen: Sequence[Capacity]) -> Capacity:
    """Return buffer sizes that suffice for all given models: 1.5 times the largest peak use in ``seen``.

    ``seen`` holds the peak use of each model, measured with random actions. The margin is needed because a trained
    policy holds objects that random actions only touch. All buffers together take 0.10 to 0.18 MB per world.
    """
    contacts, convex, rows = (1.5 * max(each) for each in zip(*map(astuple, seen), strict=True))
    return Capacity(16 * math.ceil(contacts / 16), max(2, math.ceil(convex)), 16 * math.ceil(rows / 16))

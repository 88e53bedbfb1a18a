"""Buffer sizes for contacts and constraints, which mujoco_warp allocates once at the start."""

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass

from bidex_meta.errors import BidexError
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


def check_ordered_sums(nv: int, njmax: int, num: int, substeps: int, free: int) -> None:
    """Raise BidexError if a deterministic control step of ``num`` simulations on a GPU needs more than ``free`` bytes.

    To add up the Hessian of a simulation in a fixed order, mujoco_warp stores a key (8 bytes) and a value (4 bytes) for
    each entry of its upper triangle and each of ``njmax`` rows, twice in a substep: at the start of the solver and in
    its loop. A recorded graph keeps these buffers for all ``substeps``. Sorting one of them takes another 40 bytes for
    each value, as Warp's own estimate says. ``nv`` is the number of degrees of freedom.
    """
    values = num * njmax * nv * (nv + 1) // 2
    needed = values * (24 * substeps + 40)
    if needed > free:
        fitting = int(num * free / needed)
        raise BidexError(
            f"deterministic: {num:,} environments of one kind need about {needed / 1e9:,.0f} GB on the GPU to add up "
            f"numbers in a fixed order, but {free / 1e9:,.0f} are free. Lower num_envs (about {fitting:,} of this kind "
            "fit), or leave deterministic out."
        )

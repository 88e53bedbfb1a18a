"""Room for contacts and constraints, which mujoco_warp allocates once and for all."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco


@dataclass(frozen=True)
class Capacity:
    """Room per world.

    Attributes:
        contacts: Candidate pairs of the broadphase, and contacts; all worlds share one pool of so many each.
        convex: Pairs of a kind that the convex collider (eggs, cylinders) takes on at a time; one pool too.
        rows: Constraint rows, a hard limit for each world.
    """

    contacts: int
    convex: int
    rows: int


_MEASURED = {
    "HandOver": (30, 8, 48),
    "CatchUnderarm": (29, 6, 55),
    "CatchOver2Underarm": (19, 4, 31),
    "TwoCatchUnderarm": (45, 9, 65),
    "CatchAbreast": (25, 4, 44),
    "LiftUnderarm": (31, 3, 71),
    "DoorOpenOutward": (39, 0, 104),
    "DoorOpenInward": (43, 0, 67),
    "DoorCloseOutward": (35, 0, 56),
    "DoorCloseInward": (48, 0, 52),
    "BottleCap": (34, 4, 78),
    "PushBlock": (36, 0, 80),
    "SwingCup": (32, 4, 77),
    "OpenScissors": (69, 0, 179),
    "ReOrientation": (27, 0, 57),
    "OpenPenCap": (49, 0, 101),
    "Switch": (36, 0, 65),
    "StackBlock": (39, 0, 95),
    "PourWater": (74, 16, 168),
    "GraspAndPlace": (42, 0, 116),
}
"""The most seen, by class: candidate pairs or contacts; contacts of eggs and cylinders; rows.

From ``bidex-meta bench capacity --steps 30000``: contacts and rows of 30,208 states under rough actions (half uniform,
half held at +-1), the other two in 3,776 of them (5,024 for the cylinders of pot, bottle, cup and kettle). Medians of
rows lie between 9 and 103.
"""
_DROPS, _PER_DROP = 12, (3, 1, 3)
"""PourWater was measured with so many drops of water, and what each one more adds.

Most seen in 600 states each, by ``bench/capacity.py`` on ``PourWater(water=12)``, 30 and 125: contacts 41, 73, 246;
convex 16, 34, 129; rows 103, 124, 282. So a drop adds 1.8, 1 and 1.6 at most.
"""
_HEADROOM = 1.5
"""A trained policy holds what rough actions only brush against, and room is cheap: 0.10 to 0.18 MB a world in all."""


def capacity_of(models: Sequence[mujoco.MjModel]) -> Capacity:
    """Room for models of the task classes, found by the models' names; an unknown name gets the largest room of all."""
    needs = [need for model in models for need in _needs(model)]
    contacts, convex, rows = (_HEADROOM * max(column) for column in zip(*needs, strict=True))
    return Capacity(_up(contacts, 16), max(2, math.ceil(convex)), _up(rows, 16))


def _needs(model: mujoco.MjModel) -> list[tuple[int, ...]]:
    name = model.names.split(b"\0", 1)[0].decode()
    if name not in _MEASURED:
        return list(_MEASURED.values())
    more = max(0, sum(model.body(i).name.startswith("water") for i in range(model.nbody)) - _DROPS)
    return [tuple(need + more * of_drop for need, of_drop in zip(_MEASURED[name], _PER_DROP, strict=True))]


def _up(value: float, multiple: int) -> int:
    return multiple * math.ceil(value / multiple)

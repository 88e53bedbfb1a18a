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
    "HandOver": (28, 8, 51),
    "CatchUnderarm": (28, 6, 48),
    "CatchOver2Underarm": (17, 4, 33),
    "TwoCatchUnderarm": (42, 8, 57),
    "CatchAbreast": (23, 6, 45),
    "LiftUnderarm": (36, 4, 82),
    "DoorOpenOutward": (44, 0, 96),
    "DoorOpenInward": (40, 0, 88),
    "DoorCloseOutward": (37, 0, 98),
    "DoorCloseInward": (38, 0, 77),
    "BottleCap": (47, 4, 65),
    "PushBlock": (38, 0, 103),
    "SwingCup": (34, 4, 87),
    "OpenScissors": (57, 0, 131),
    "ReOrientation": (26, 0, 67),
    "OpenPenCap": (56, 0, 121),
    "Switch": (36, 0, 90),
    "StackBlock": (43, 0, 115),
    "PourWater": (71, 20, 134),
    "GraspAndPlace": (35, 4, 108),
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

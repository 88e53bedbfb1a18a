"""Scripted policies for eggs that lie on a palm: a tilted hand with bent fingers is a basket that carries the egg.

A throw would be quicker, but a thrown egg is often lost.
"""

from torch import Tensor

from bidex_meta.witness.controller import Actions, HandController, Point, point
from bidex_meta.witness.scripts.between import ramp

_BENT = (0.9, 1.2)  # angles of knuckles and middle joints, rad; a fist would squeeze the egg out on the wrist's side
_TILT = 0.5  # angle by which the wrist is higher than the fingers, rad: the egg rolls onto the fingers
# Hands that exchange their places turn until their forearms point sideways (rad), and pass each other at a distance.
_YAW = 1.2
_ASIDE = 0.15  # distance along x of each egg from the straight way, metres


def carry_egg(hands: HandController) -> Actions:
    """Carry the egg to its goal in the right hand; the left hand moves out of the way."""
    hands.bend("right", *_BENT)
    hands.bend("left", 0.0, 0.0)
    hands.hold("left")
    while hands.steps_left:
        hands.hold("right", roll=_TILT)
        x, y, z = point(hands.at("left"))
        yield from hands.lead_each((_carry(hands, "right", "", 0.0), (x, y - 0.2, z)))


def exchange_eggs(hands: HandController) -> Actions:
    """Carry two eggs past each other, each in the hand on which it lies, to the place of the other hand."""
    hands.bend("right", *_BENT)
    hands.bend("left", *_BENT)
    while hands.steps_left:
        ahead = float((hands.at("right") - hands.at("left"))[1])
        yaw = -_YAW * ramp(ahead, 0.38, 0.2)
        aside = _ASIDE * ramp(abs(ahead), 0.3, 0.12)
        hands.hold("right", roll=_TILT, yaw=yaw)
        hands.hold("left", roll=-_TILT, yaw=yaw)
        yield from hands.lead_each((_carry(hands, "right", "1", aside), _carry(hands, "left", "2", -aside)))


def _carry(hands: HandController, side: str, number: str, aside: float) -> Point:
    """Return the target of a hand that carries an egg to its goal, or ``aside`` (m) of it along x, once it is tilted.

    ``number`` is the suffix of the names of the egg and its goal.
    """
    way: Tensor = hands.frozen(f"goal{number}")[:3] - hands.where(f"object{number}/position")
    way[0] += aside
    return point(hands.at(side) + way * ramp(hands.still_to_turn(side), 0.2, 0.1))

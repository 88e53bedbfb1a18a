"""Scripted policy that lifts a pot."""

import math

from torch import Tensor

from bidex_meta.witness.controller import Actions, HandController, beside

_BACK = 0.698  # angle in rad by which a wrist bends back
# This is the position in metres of a hand's point relative to the pot's origin when its fingertips carry a grip of the
# pot.
_REACH = 0.1755 + 0.085
_GRIP_HEIGHT = 0.068


def lift_underarm(hands: HandController) -> Actions:
    """Bring the hands, bent back as far as the wrists allow, under the pot's grips, and lift the pot to its goal."""
    # Throwing the pot to its goal earns more reward than lifting it there.
    pot = hands.where("object/position")
    out = (hands.where("object/right_handle_position") - pot) / 0.15  # unit vector from the pot to the right grip
    yaw = math.atan2(-float(out[0]), float(out[1]))
    for side, sign in (("right", -1.0), ("left", 1.0)):
        # The wrist rests against the joint's limit, because its motor is too weak for the pot.
        hands.bend(side, 0.0, 0.0, WRJ0=-_BACK)
        hands.hold(side, roll=sign * (_BACK + 0.1), yaw=yaw)
    out[2] = 0.0

    def under(middle: Tensor, height: float, steps: int, speed: float, reach: float = _REACH) -> Actions:
        right = middle + reach * out
        left = middle - reach * out
        yield from hands.lead(beside(right, 0.0, 0.0, height), beside(left, 0.0, 0.0, height), steps, speed)

    height = float(pot[2]) + _GRIP_HEIGHT
    yield from under(pot, height - 0.06, 25, 0.6, reach=_REACH + 0.1)
    yield from under(pot, height - 0.04, 30, 0.3)
    yield from under(pot, height, 30, 0.1)
    way = hands.frozen("goal")[:3] - pot
    for i in range(150):
        share = (i + 1) / 150
        yield from under(pot + share * way, height + share * float(way[2]), 1, 0.6)
    yield from under(pot + way, height + float(way[2]), hands.episode_steps, 0.6)

"""Scripted policy that throws an egg down from an upright hand and catches it with the fingers of the other hand."""

import math

from torch import Tensor

from bidex_meta.witness.controller import Actions, HandController, Point, point
from bidex_meta.witness.scripts.between import ramp

# The right hand waits with its wrist bent back and leaning back (wrist and roll, rad) until the falling egg is below a
# height, metres. Then it swings ahead until the egg is faster than a speed along -y, m/s, or has left the fingers.
_BACK = -0.7, -0.268
_AHEAD = 0.49, 0.794
_LOW = 0.997
_FAST = 1.359
_GONE = -0.03, 0.9  # y and height in metres below which the egg has left the right fingers
_STAYS: Point = (0.009, 0.036, 0.865)  # place of the right hand's point, metres
# Angles in rad of the left hand's knuckles, middle joints and wrist, while it waits for the egg and while it holds it.
_OPEN = 0.6, 1.041, -0.7
_CLOSED = 1.089, 1.232, -0.4
_HOME = (0.0, -0.8, 0.5)  # start of the left hand's mount, metres
_REACH = 0.096  # distance in metres of the mount from its start; at 0.1 m the episode fails
_REST = -0.026, 0.05  # where an egg lies in the fingers, relative to the hand's point: along y, and up, metres
_ASIDE = 0.015  # by how much farther along x than the hand's point the egg should arrive, metres
_NEAR = 0.07  # height in metres above the fingers below which the egg is caught
_STEP = 0.014  # distance by which the target leads a hand that carries the egg, metres: a fast hand loses it
_GRAVITY = 9.81


def throw_down(hands: HandController) -> Actions:
    """Strike the falling egg towards the left hand, catch it where it will come down, and carry it to its goal."""
    while hands.steps_left:
        egg = hands.where("object/position")
        speed = hands.where("object/linear_velocity")
        _swing(hands, egg, speed)
        hands.hold("left")
        at = hands.at("left")
        over = float(egg[2] - at[2]) - _REST[1]
        if over > _NEAR:
            bent = _OPEN
            way = _meet(egg, speed, over, at)
        else:
            bent = _CLOSED
            way = _carry(hands, egg, float(speed.norm()))
        hands.bend("left", bent[0], bent[1], WRJ0=bent[2])
        mount = hands.where("left/mount_position")
        out = mount + way - mount.new_tensor(_HOME)
        out *= min(1.0, _REACH / (float(out.norm()) + 1e-9))
        yield from hands.lead_each((_STAYS, point(at + out - mount + mount.new_tensor(_HOME))), 1.0)


def _swing(hands: HandController, egg: Tensor, speed: Tensor) -> None:
    """Bend the right wrist and turn the right hand: back while the egg falls, then ahead to strike it."""
    if egg[2] > _LOW:
        wrist, roll = _BACK
    elif egg[1] > _GONE[0] and egg[2] > _GONE[1] and -speed[1] < _FAST:
        wrist, roll = _AHEAD
    else:
        wrist = _AHEAD[0]
        roll = 0.0
    hands.bend("right", 0.0, 0.0, WRJ0=wrist)
    hands.hold("right", roll=roll)


def _meet(egg: Tensor, speed: Tensor, over: float, at: Tensor) -> Tensor:
    """Return the horizontal way (3,) of the left hand, whose point is ``at``, to where the egg will come down, metres.

    The egg flies freely until it is ``over`` metres lower. The hand waits until the egg has been struck.
    """
    if -speed[1] < 0.5:
        return 0.0 * at
    up = float(speed[2])
    time = (up + math.sqrt(up * up + 2.0 * _GRAVITY * over)) / _GRAVITY
    way = egg + time * speed - at
    way[0] -= _ASIDE
    way[2] = 0.0
    return way


def _carry(hands: HandController, egg: Tensor, speed: float) -> Tensor:
    """Return the way (3,) of the left hand, metres: below an egg that still moves, then with the egg to its goal."""
    lies = ramp(speed, 0.4, 0.2)
    way = hands.frozen("goal")[:3] - egg
    way *= lies * min(1.0, _STEP / (float(way.norm()) + 1e-9))
    below = egg - hands.at("left")
    below[1] -= _REST[0]
    below[2] = 0.0
    return way + (1.0 - lies) * below

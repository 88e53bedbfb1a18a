"""Scripted policies in which one finger moves an object: a bottle's cap, or a cup by its handle."""

import math
from itertools import product

import torch
from torch import Tensor

from bidex_meta.utils.maths import rotate
from bidex_meta.witness.controller import Actions, HandController, Point, beside, point

_TIP = 0.035  # distance in metres from a finger's last joint to the part of its tip that touches a cap's axis
# Joint angles, rad, at which the right thumb stays behind the bottle.
_HELD = {"THJ4": -1.04, "THJ3": 1.2, "THJ0": -1.57}
_FIST = {f"{finger}J{joint}": 1.4 for finger, joint in product(("FF", "MF", "RF"), (1, 2))}


def pull_cap(hands: HandController) -> Actions:
    """Press the left little finger on the cap's side, and drag the cap along the bottle by friction."""
    slide = float(hands.frozen("slide"))
    stay = point(hands.at("right"))
    for side in ("right", "left"):
        hands.hold(side)
    ahead = _ahead(hands)

    def poke(back: float) -> Point:
        """Return the left hand's point at which the little finger's tip is ``back`` metres short of the cap's centre.

        The distance is measured in the direction in which the fingers point.
        """
        cap = hands.where("bottle/cap_position") - (_TIP + back) * ahead
        return point(hands.at("left") + cap - hands.where("left/lfdistal_position"))

    hands.bend("right", 0.5, 0.6, **_HELD)
    hands.bend("left", 0.0, 0.0, **_FIST)
    first = hands.at("left") - 0.07 * ahead
    yield from hands.lead(stay, point(first), 10, speed=0.4)
    hands.bend("right", 0.9, 1.0, **_HELD)
    for _ in range(27):
        yield from hands.lead(stay, poke(0.04), speed=0.4)
    for _ in range(11):
        yield from hands.lead(stay, poke(-0.002), speed=0.2)
    still = 0
    while hands.steps_left:
        left = slide - float(hands.where("bottle/slide"))
        if abs(left) < 0.0015 or still > 3:
            still = still + 1
        else:
            still = 0
        if still > 3:
            yield from hands.lead(stay, point(hands.at("left") - 0.01 * ahead), speed=0.2)
            continue
        way = max(-0.012, min(0.012, 0.45 * left)) * _axis(hands) + 0.0012 * ahead
        yield from hands.lead(stay, point(hands.at("left") + way), speed=0.3)


def _axis(hands: HandController) -> Tensor:
    """Return the direction in which the cap slides, world."""
    return rotate(hands.orientation("bottle/quaternion"), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))


def _ahead(hands: HandController) -> Tensor:
    """Return the direction in which the left hand's straight fingers point, world."""
    way = hands.where("left/palm_position") - hands.where("left/mount_position")
    return way / way.norm()


_PEG = 0.015  # height of a peg (a bent finger) above the cup's origin, metres; higher pegs tip the cup
# Radius of the peg's circle about the cup, and of the right fingertips' circle, metres; angle of either behind a handle
# that it pushes, rad; angle of the left handle from which on the right hand pushes it, rad: the left thumb would meet
# the lid.
_RADIUS = 0.068
_TIP_RADIUS = 0.078
_TOUCH = 0.2
_FAR = 0.5
_FINGERTIP = 0.031  # distance in metres from a finger's last joint to its tip


def swing_cup(hands: HandController) -> Actions:
    """Turn a cup to its goal angle by moving its left handle.

    The left little finger, bent like a peg, first pulls the handle around. Then the right fingers push the handle on.
    """
    # At an ear, friction on the foot lets the cup turn on its place sooner than slide.
    away = 0.23, 0.16, float(hands.at("right")[2]) - 0.1
    hands.hold("left", roll=-0.5 * math.pi)
    hands.hold("right")
    hands.bend("right", 0.0, 0.0)
    hands.bend("left", 0.0, 0.0, THJ4=-1.04, THJ1=-0.5, LFJ2=1.57, **_FIST)

    def peg(behind: float, height: float, radius: float = _RADIUS) -> Point:
        """Return the left hand's point at which the hand's little finger is near the cup's handle.

        At this point the finger is on a circle of this ``radius`` about the cup, at an angle ``behind`` the handle
        (rad), and ``height`` above the cup's origin. Lengths are in metres.
        """
        return point(hands.at("left") + _behind(hands, behind, radius, height) - hands.where("left/lfdistal_position"))

    x, y, z = hands.at("left").tolist()
    yield from hands.lead(away, (x, y - 0.05, z + 0.1), 65, speed=0.3)
    for _ in range(30):
        yield from hands.lead(away, peg(0.9, 0.12, 0.1), speed=0.4)
    for _ in range(20):
        yield from hands.lead(away, peg(0.8, _PEG, 0.1), speed=0.4)
    while hands.steps_left:
        missing = _missing(hands)
        missing += 2.0 * math.pi if missing < -1.0 else 0.0
        if missing < 0.05 + 0.08 * float(hands.where("cup/angular_velocity")[2]):
            yield from hands.lead(away, peg(_TOUCH + 0.4, _PEG, 0.1), speed=0.2)
        elif _yaw(hands) % (2.0 * math.pi) - math.pi > _FAR:
            yield from _push_on(hands)
        else:
            yield from hands.lead(away, peg(_TOUCH - min(0.3, missing), _PEG), speed=0.2)


def _push_on(hands: HandController) -> Actions:
    """Push the cup's left handle to its goal with the right hand's straight fingers; the left hand moves aside."""
    x, y, z = hands.at("left").tolist()
    back = (x + 0.05, y - 0.08, z)
    aside = (x + 0.05, y - 0.3, z + 0.1)

    def tip(behind: float, before: float = 0.0) -> Point:
        """Return the right hand's point at which the hand's middle fingertip is near the cup's handle.

        At this point the fingertip is at an angle ``behind`` the handle (rad), but ``before`` metres short of this
        place along x.
        """
        way = _behind(hands, behind, _TIP_RADIUS, 0.0) - hands.where("right/mfdistal_position")
        return beside(hands.at("right") + way, _FINGERTIP + before, 0.0, float((hands.at("right") + way)[2]))

    for _ in range(8):
        yield from hands.lead(tip(_TOUCH, 0.1), back, speed=0.4)
    for _ in range(12):
        yield from hands.lead(tip(_TOUCH, 0.03), aside, speed=0.4)
    while hands.steps_left and _missing(hands) > 0.05:
        yield from hands.lead(tip(_TOUCH - min(0.3, _missing(hands))), aside, speed=0.2)
    # The hand stays, because a cup that is touched on the way back turns further.
    yield from hands.lead(point(hands.at("right")), aside, hands.episode_steps)


def _behind(hands: HandController, angle: float, radius: float, height: float) -> Tensor:
    """Return a point (3,) on a horizontal circle about the cup, world, metres.

    The point is ``angle`` (rad) behind the left handle: clockwise from it, because the cup is turned counterclockwise.
    ``radius`` is the circle's radius, and ``height`` is its height above the cup's origin, metres.
    """
    cup = hands.where("cup/position")
    at = _yaw(hands) + math.pi - angle
    return cup + torch.tensor([radius * math.cos(at), radius * math.sin(at), height], dtype=cup.dtype)


def _missing(hands: HandController) -> float:
    """Return the angle by which the cup must still turn, in [-pi, pi), rad."""
    goal = hands.frozen("goal")
    wanted = 2.0 * math.atan2(float(goal[5]), float(goal[6]))
    return (wanted - _yaw(hands) + math.pi) % (2.0 * math.pi) - math.pi


def _yaw(hands: HandController) -> float:
    """Return the angle of the cup's right handle about the vertical axis, rad."""
    turn = hands.orientation("cup/quaternion")
    return 2.0 * math.atan2(float(turn[2]), float(turn[3]))

"""Scripted policies in which one finger moves an object: a bottle's cap, or a cup by its handle."""

import math
from itertools import product

import torch
from torch import Tensor

from bidex_meta.utils.maths import rotate
from bidex_meta.witness.controller import Actions, HandController, Point, point
from bidex_meta.witness.scripts.between import ramp

_TIP = 0.035  # distance in metres from a finger's last joint to the part of its tip that touches a cap's axis
# Joint angles, rad, at which the right thumb stays behind the bottle.
_HELD = {"THJ4": -1.04, "THJ3": 1.2, "THJ0": -1.57}
_FIST = {f"{finger}J{joint}": 1.4 for finger, joint in product(("FF", "MF", "RF"), (1, 2))}


_STAYS: Point = (0.0076, -0.62, 0.4564)  # start of the right hand, in which the bottle lies, metres
# Distances in metres between the fingertip and the cap's side along the finger: while the hand comes near, from which
# on the finger drags the cap, and after the hand has let go.
_BEFORE = 0.04
_TOUCHES = 0.014
_GONE = 0.03
# Errors of the cap's travel in metres at which the hand lets go, and up to which it does not come back.
_DONE = 0.0025
_GOOD = 0.005


def pull_cap(hands: HandController) -> Actions:
    """Press the left little finger on the cap's side, and drag the cap along the bottle by friction."""
    # All targets are functions of the present state, so that a policy without memory can learn them.
    slide = float(hands.frozen("slide"))
    for side in ("right", "left"):
        hands.hold(side)
    hands.bend("left", 0.0, 0.0, **_FIST)
    while hands.steps_left:
        thumb = ramp(-float(hands.where("right/THJ4_position")), 0.7, 1.0)
        hands.bend("right", 0.5 + 0.4 * thumb, 0.6 + 0.4 * thumb, **_HELD)
        missing = slide - float(hands.where("bottle/slide"))
        yield from hands.lead(_STAYS, point(hands.at("left") + _to_cap(hands, missing)), speed=0.4)


def _to_cap(hands: HandController, missing: float) -> Tensor:
    """Return the next way of the left hand (3,), metres: to the cap's side, along the bottle with the cap, and back.

    ``missing`` is the distance by which the cap must still be pulled, metres.
    """
    ahead = _ahead(hands)
    axis = _axis(hands)
    way = hands.where("bottle/cap_position") - _TIP * ahead - hands.where("left/lfdistal_position")
    before = float(way.dot(ahead))
    if float(hands.where("left/MFJ2_position")) < 1.05:  # the other fingers must bend before the hand comes near
        return -0.02 * ahead
    if abs(missing) < _DONE or (abs(missing) < _GOOD and before > 0.02):
        return (before - _GONE) * ahead
    aside = way - before * ahead
    along = float(aside.dot(axis))
    off = float((aside - along * axis).norm())
    near = ramp(off, 0.02, 0.01) * ramp(abs(along), 0.025, 0.015)
    advance = aside + (before - (1.0 - near) * _BEFORE) * ahead
    if near > 0.5:  # a fast finger would knock the bottle out of the hand
        advance *= min(1.0, 0.025 / (float(advance.norm()) + 1e-9))
    pressed = 0.0015 + max(0.0, before - 0.006)
    drag = max(-0.016, min(0.016, 0.8 * missing)) * axis + pressed * ahead
    touch = near * ramp(before, 0.02, _TOUCHES)
    return touch * drag + (1.0 - touch) * advance


def _axis(hands: HandController) -> Tensor:
    """Return the direction in which the cap slides, in the world frame."""
    return rotate(hands.orientation("bottle/quaternion"), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))


def _ahead(hands: HandController) -> Tensor:
    """Return the direction in which the left hand's straight fingers point, in the world frame."""
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
# Places in metres at which the right hand is out of the way and the left hand rolls.
_AWAY: Point = (0.23, 0.16, 0.7)
_UP: Point = (-0.02, -0.24, 0.9)
_FINGERTIP = 0.031  # distance in metres from a finger's last joint to its tip


def swing_cup(hands: HandController) -> Actions:
    """Turn a cup to its goal angle by moving its left handle.

    The left little finger, bent like a peg, first pulls the handle around. Then the right fingers push the handle on.
    """
    # At an ear, friction on the foot lets the cup turn on its place sooner than slide. All targets are functions of the
    # present state, so that a policy without memory can learn them.
    hands.hold("left", roll=-0.5 * math.pi)
    hands.hold("right")
    hands.bend("right", 0.0, 0.0)
    hands.bend("left", 0.0, 0.0, THJ4=-1.04, THJ1=-0.5, LFJ2=1.57, **_FIST)
    while hands.steps_left:
        missing = _missing(hands)
        if missing < -1.0:
            missing += 2.0 * math.pi
        if _yaw(hands) % (2.0 * math.pi) - math.pi > _FAR:
            right = _push(hands, missing)
            left = _aside(hands)
        else:
            right = _AWAY
            left = _pull(hands, missing)
        around, height = _peg(hands)
        speed = 0.2 if around < 0.09 and height < 0.04 else 0.4  # a fast peg tips the cup
        yield from hands.lead(right, left, speed=speed)


def _peg(hands: HandController) -> tuple[float, float]:
    """Return the peg's distance from the cup's axis and its height above the cup's origin, metres."""
    gap = hands.where("left/lfdistal_position") - hands.where("cup/position")
    return float(gap[:2].norm()), float(gap[2])


def _pull(hands: HandController, missing: float) -> Point:
    """Return the next target of the left hand: over the cup, down behind the handle, around with it, and back.

    ``missing`` is the angle by which the cup must still turn, rad. The hand first waits high above its start until it
    has rolled and the right hand has left.
    """
    if hands.still_to_turn("left") > 0.15 or float(hands.at("right")[0]) < 0.18:
        return _UP
    around, height = _peg(hands)

    def way(behind: float, height: float, radius: float = _RADIUS) -> Tensor:
        """Return the way of the peg to an angle ``behind`` the handle, rad, and a ``height`` above the cup's origin."""
        return _behind(hands, behind, radius, height) - hands.where("left/lfdistal_position")

    if height > 0.04 or (height > 0.027 and around > 0.085):
        over = way(0.9, 0.12, 0.1)
        if height > 0.1:
            down = ramp(float(over[:2].norm()), 0.03, 0.015)
        else:
            down = 1.0
        return point(hands.at("left") + over + down * (way(0.8, _PEG, 0.1) - over))
    if missing < 0.05 + 0.08 * float(hands.where("cup/angular_velocity")[2]):
        return point(hands.at("left") + way(_TOUCH + 0.4, _PEG, 0.1))
    return point(hands.at("left") + way(_TOUCH - min(0.2, 0.05 + 0.3 * missing), _PEG))


def _aside(hands: HandController) -> Point:
    """Return the next target of the left hand: away from the handle, then to a place next to the table."""
    free = ramp(_peg(hands)[0], 0.09, 0.13)
    x, y, z = hands.at("left").tolist()
    return x + 0.05 + free * (0.1 - x), y - 0.08 - free * (0.27 + y), z + free * (0.86 - z)


def _push(hands: HandController, missing: float) -> Point:
    """Return the next target of the right hand: behind the handle, then push it on with straight fingers.

    ``missing`` is the angle by which the cup must still turn, rad.
    """
    if missing < 0.05:  # the hand stays, because a cup that is touched on the way back turns further
        return point(hands.at("right"))

    def way(behind: float) -> Tensor:
        """Return the way of the middle fingertip to an angle ``behind`` the handle, rad."""
        found = _behind(hands, behind, _TIP_RADIUS, 0.0) - hands.where("right/mfdistal_position")
        found[0] += _FINGERTIP
        return found

    near = ramp(abs(float(way(_TOUCH)[1])), 0.04, 0.02)
    # The last 0.12 rad overcome the friction on the cup's foot.
    target = way(_TOUCH - near * min(0.35, missing + 0.12))
    target[0] += 0.1 * (1.0 - near)
    return point(hands.at("right") + target)


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

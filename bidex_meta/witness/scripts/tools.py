"""Scripted closed-loop policies for switches, pen and scissors; they read the task's goal."""

import math

import torch
from torch import Tensor

from bidex_meta.hands.hand import SIDES
from bidex_meta.witness.controller import Actions, HandController, Point, point
from bidex_meta.witness.scripts.between import ramp

_LEVER = 0.035  # distance in metres from a rocker's hinge to its button
_CLEAR = 0.04  # height of a fingertip that is clear of its button, metres
# Angles before the requested one at which a finger begins to rise, and from which on it rises at full speed, rad. A
# rocker that is pressed too far does not come back, so both count from where the rocker will be after _LAG seconds: the
# finger still presses while it begins to rise.
_ENOUGH = 0.045, 0.025
_LAG = 0.03


def press_switches(hands: HandController) -> Actions:
    """Press each button with the middle finger until its rocker has the requested angle, and rise again."""
    wanted = hands.frozen("angles").tolist()[::-1]
    for side in SIDES:
        hands.bend(side, 0.0, 0.0, MFJ2=0.9, MFJ1=0.5, THJ3=0.5)
        hands.hold(side)
    while hands.steps_left:
        points: list[Point] = []
        for side, name, angle in zip(SIDES, ("switch2", "switch1"), wanted, strict=True):
            left = angle - float(hands.where(f"{name}/angle"))
            above = _tip(hands, side, _button(hands, name), _CLEAR)
            x, y, height = point(hands.at(side))
            off = math.hypot(above[0] - x, above[1] - y)
            if off > 0.02 or height > above[2]:
                press = above[2] - height
            else:
                press = -min(0.004, max(0.002, 0.8 * _LEVER * (left - 0.03)))
            soon = left - _LAG * float(hands.where(f"{name}/angular_velocity").norm())
            rise = min(0.08, above[2] + 0.1 - height)
            height += press + ramp(soon, *_ENOUGH) * (rise - press)
            points.append((above[0], above[1], height))
        yield from hands.lead_each(points, 1.2)


def _button(hands: HandController, name: str) -> Tensor:
    return hands.where(f"{name}/button_position")


def _tip(hands: HandController, side: str, target: Tensor, height: float, finger: str = "mf") -> Point:
    """Return the hand's point at which the last joint of a finger is ``height`` metres above ``target``."""
    goal = target + torch.tensor([0.0, 0.0, height], dtype=target.dtype)
    return point(hands.at(side) + goal - hands.where(f"{side}/{finger}distal_position"))


_ENDS = {"right": "pen/cap_position", "left": "pen/body_position"}


def open_pen(hands: HandController) -> Actions:
    """Close both hands around the pen, at body and cap, and move them apart to the requested gap."""
    gap = float(hands.frozen("gap"))
    while hands.steps_left:
        out = hands.where(_ENDS["right"]) - hands.where(_ENDS["left"])
        now = float(out.norm())
        yaw = math.atan2(-float(out[0]), float(out[1]))
        closed = min(ramp(float(hands.where(f"{side}/MFJ2_position")), 1.0, 1.15) for side in SIDES)
        way = closed * max(-0.04, min(0.04, 0.6 * (gap - now)))
        points = []
        for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
            hands.hold(side, yaw=yaw)
            points.append(_around(hands, side, out / now, sign * way, closed))
        yield from hands.lead_each(points, 1.6)


def _around(hands: HandController, side: str, along: Tensor, way: float, closed: float) -> Point:
    """Bend a hand's fingers around its end of the pen, and return the next target of the hand, metres.

    ``closed`` rises from 0 to 1 as both hands close. At 0 the hand moves to its end of the pen; at 1 it moves ``way``
    metres along the pen, in the direction ``along``.
    """
    end = hands.where(_ENDS[side]).clone()
    at = hands.at(side)
    end[0] -= 0.008
    over = float(at[2] - end[2])
    off = float((end - at)[:2].norm())
    near = ramp(off, 0.04, 0.015)
    fist = max(ramp(float(hands.where(f"{side}/MFJ2_position")), 1.05, 1.2), near * ramp(over, 0.054, 0.046))
    hands.bend(side, 0.6 + 0.3 * near + 0.65 * fist, 0.6 + 0.4 * near + 0.65 * fist, THJ3=0.6, THJ4=0.6)
    goal = at + way * along + (1.0 - closed) * (end - at)
    above = float(end[2]) + 0.06 - 0.04 * near
    return float(goal[0]), float(goal[1]), above + closed * (0.65 - above)


_HOOKS = {"right": "ff", "left": "lf"}  # the finger of each hand on the side of the other hand


def open_scissors(hands: HandController) -> Actions:
    """Put a bent finger of each hand into its loop, pull the loops apart to the requested angle, and rise."""
    target = float(hands.frozen("target"))
    loops = {"right": "scissors/right_handle_position", "left": "scissors/left_handle_position"}
    for side in SIDES:
        hands.bend(side, 0.0, 0.0, THJ3=0.5, **{f"{_HOOKS[side].upper()}J2": 1.5})
        hands.hold(side)

    def over(height: float, steps: int, speed: float) -> Actions:
        for _ in range(steps):
            yield from hands.lead_each(
                (_tip(hands, side, hands.where(loops[side]), height, _HOOKS[side]) for side in SIDES), speed
            )

    yield from over(0.08, 28, 1.6)
    yield from over(0.022, 16, 0.5)
    while hands.steps_left:
        left = target - float(hands.where("scissors/angle"))
        right_loop = hands.where(loops["right"])
        left_loop = hands.where(loops["left"])
        out = (right_loop - left_loop) / (right_loop - left_loop).norm()
        way = max(-0.025, min(0.025, 0.5 * left)) * out
        a = hands.at("right") + way
        b = hands.at("left") - way
        heights = [_tip(hands, side, hands.where(loops[side]), 0.022, _HOOKS[side])[2] for side in SIDES]
        yield from hands.lead((float(a[0]), float(a[1]), heights[0]), (float(b[0]), float(b[1]), heights[1]))

"""Scripted policy that pours water from a kettle into a bucket; in version 2 it then carries the bucket to its goal."""

import math

from torch import Tensor

from bidex_meta.hands.hand import SIDES
from bidex_meta.witness.controller import Actions, HandController, Point, beside, point
from bidex_meta.witness.scripts.between import ramp

# The first value is the rotation that lays the left fingers on the underside of the kettle's trough, the second the
# kettle's tilt in rad when it pours.
_TROUGH = math.radians(59.0)
_POUR = math.radians(50.0)
_RUNNING = 25  # number of steps in which the water runs out
# These values are in metres.
_STANDS = 0.457  # height of a bucket on the table
_AHEAD = 0.03  # offset of the hands' points from the bucket along x
_UP = 0.03  # height of the hands' points above a standing bucket's origin; below, the left thumb would touch the table
_OVER = 0.18  # how much higher the hands pass over the bucket
_LIFT = 0.012
_APART = 0.13  # half the distance of the hands before they close
_SIGNS = (1.0, -1.0)  # sides of the bucket along y on which the right and the left hand are


def pour_water(hands: HandController) -> Actions:
    """Grip handle and spout, lift the kettle and tilt it; in version 2 then put it down and carry the bucket."""
    # The reward ignores the water itself.
    kettle = hands.where("kettle/position")
    bucket = hands.where("bucket/position")
    back = hands.where("kettle/handle_position") - kettle  # from spout to handle
    back = back / back.norm()

    def grip(origin: Tensor, tilt: float = 0.0, aside: float = 0.0, loose: float = -0.003, steps: int = 1) -> Actions:
        """Move both hands to the places where they hold a kettle.

        ``origin`` is the kettle's origin, and ``tilt`` is the kettle's tilt towards the spout, rad. The hands keep a
        distance of ``loose`` metres from the kettle, or press it if ``loose`` is negative. They are shifted by
        ``aside`` metres along x.
        """

        def at(x: float, along: float, up: float) -> Point:
            flat = along * math.cos(tilt) - up * math.sin(tilt)
            rise = along * math.sin(tilt) + up * math.cos(tilt)
            return beside(origin + flat * back, x + aside, 0.0, float(origin[2]) + rise)

        hands.hold("right", roll=tilt)
        hands.hold("left", roll=_TROUGH + tilt)
        yield from hands.lead(
            at(-0.005, 0.159 + 0.2 * loose, -0.004), at(0.065, -0.153, 0.030 - loose), steps, speed=1.0
        )

    hands.bend("right", 0.0, 0.0)
    hands.bend("left", 0.0, 0.0, THJ4=1.047, THJ3=1.222)  # the thumb lies across the palm, away from the kettle's wall
    yield from grip(kettle, aside=0.15, loose=0.025, steps=26)
    yield from grip(kettle, loose=0.025, steps=17)
    hands.bend("right", 1.2, 1.5)
    yield from grip(kettle, steps=17)
    sine = math.sin(_POUR)
    cosine = math.cos(_POUR)
    # Position of the tilted kettle's lip along ``back`` and up.
    lip = -0.2 * cosine - 0.053 * sine, 0.053 * cosine - 0.2 * sine
    way = bucket + (0.07 - lip[0]) * back - kettle
    way[2] += 0.098 - lip[1]
    across = back.new_tensor([-float(back[1]), float(back[0]), 0.0])
    for i in range(34):
        share = (i + 1) / 34
        if hands.wide and share > 0.5:  # the left hand may have moved the spout aside
            way += 0.1 * across.dot(bucket - hands.where("kettle/spout_position")) * across
        there = kettle + share * way
        there[2] = kettle[2] + min(1.0, 1.3 * share) * way[2]  # the left hand first rises, to clear the bucket's rim
        yield from grip(there, share * _POUR)
    if not hands.wide:
        yield from grip(kettle + way, _POUR, steps=hands.episode_steps)
        return
    yield from grip(kettle + way, _POUR, steps=_RUNNING)
    away = kettle.clone()
    away[1] += 0.2  # otherwise hand and kettle meet when the hand takes the bucket
    for i in range(60):
        share = 1.0 - (i + 1) / 60
        there = away + share * (kettle + way - away)
        there[2] = kettle[2] + min(1.0, 1.5 * share) * way[2]
        yield from grip(there, max(0.0, 1.5 * share - 0.5) * _POUR)
    yield from grip(away, steps=15)
    hands.bend("right", 0.0, 0.0)
    yield from grip(away, loose=0.025, steps=15)
    yield from grip(away, aside=0.2, loose=0.025, steps=25)
    yield from _carry_bucket(hands)


def _carry_bucket(hands: HandController) -> Actions:
    """Clamp the bucket between both palms, carry it to its goal and hold it there until the episode ends."""
    goal = hands.frozen("goal")[:3]
    # The thumbs are moved out of the way. The left thumb points down, so it is bent.
    hands.bend("right", 0.3, 0.0, THJ4=-1.047)
    hands.bend("left", 0.3, 0.0, THJ4=-1.047, THJ1=-0.5, THJ0=-1.57)
    for side in SIDES:
        hands.hold(side)
    while hands.steps_left:
        bucket = hands.where("bucket/position")
        ways = [hands.at(side) - bucket for side in SIDES]
        width = 0.5 * float(ways[0][1] - ways[1][1])
        around = 1.0
        for way, sign in zip(ways, _SIGNS, strict=True):
            around *= _beside(way, sign) * ramp(float(way[2]) - _UP, 0.05, 0.03)
        held = around * ramp(width, 0.065, 0.06)
        # The nearer hand waits for the other, because a bucket that is pushed on one side tips over.
        farther = max(float(ways[0][1]), -float(ways[1][1]))
        closer = farther + held * (width - farther) - 0.015 - 0.02 * ramp(width, 0.075, 0.095)
        half = _APART + around * (closer - _APART)
        rest = goal - bucket
        far = float(rest[:2].norm())
        rest *= held * min(1.0, 0.04 / (far + 1e-9))
        rest[2] = _STANDS + _UP - bucket[2] + held * _LIFT * ramp(far, 0.01, 0.02)
        points = [point(bucket + rest + _next(way, sign, half)) for way, sign in zip(ways, _SIGNS, strict=True)]
        yield from hands.lead_each(points, 1.0)


def _beside(way: Tensor, sign: float) -> float:
    """Return 1 if a hand is on its side of the bucket, 0 if not, and numbers between for a hand on its way there.

    ``way`` is the vector from the bucket to the hand, metres; ``sign`` is 1 for the side at +y and -1 for -y.
    """
    return ramp(abs(float(way[0]) - _AHEAD), 0.05, 0.03) * ramp(sign * float(way[1]), 0.03, 0.045)


def _next(way: Tensor, sign: float, half: float) -> Tensor:
    """Return the next waypoint (3,) of a hand that goes over the bucket to its side, and then down.

    ``way`` is the vector from the bucket to the hand's present position. The waypoint's x and y are offsets from the
    bucket, too. Its z is measured from the height at which the hands clamp a bucket that stands on the table. Lengths
    are in metres. ``sign`` is 1 for the side at +y and -1 for -y; ``half`` is the distance along y that the hand should
    have from the bucket.
    """
    x, y, z = way.tolist()
    over = z - _UP
    at_side = _beside(way, sign)
    outside = ramp(abs(x - _AHEAD), 0.04, 0.02) * ramp(sign * y, _APART - 0.02, _APART - 0.005)
    down = max(outside, at_side * ramp(over, 0.06, 0.04))
    free = max(ramp(over, 0.12, 0.16), at_side)
    return way.new_tensor([x + free * (_AHEAD - x), y + free * (sign * half - y), _OVER * (1.0 - down)])

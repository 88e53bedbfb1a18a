"""Scripted policies for the pot and the kettle."""

import math

from torch import Tensor

from bidex_meta.witness.controller import Actions, HandController, Point, beside

_BACK = 0.698  # how far a wrist bends back, rad
# Position of a hand's point, from the pot's origin, if its fingertips carry a grip of the pot, metres.
_REACH = 0.1755 + 0.085
_GRIP_HEIGHT = 0.068
# Turn that lays the left fingers on the underside of the kettle's trough; the kettle's tilt when it pours, rad.
_TROUGH = math.radians(59.0)
_POUR = math.radians(50.0)


def lift_underarm(hands: HandController) -> Actions:
    """Bring the hands under the pot's grips, bent back as far as their wrists allow, and lift the pot to its goal."""
    # A pot that is thrown to its goal pays before one that is lifted there.
    pot = hands.where("object/position")
    out = (hands.where("object/right_handle_position") - pot) / 0.15  # from the pot to the right grip, of length 1
    yaw = math.atan2(-float(out[0]), float(out[1]))
    for side, sign in (("right", -1.0), ("left", 1.0)):
        hands.bend(side, 0.0, 0.0, WRJ0=-_BACK)  # against the joint's limit: a wrist's motor is weaker than the pot
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


def pour_water(hands: HandController) -> Actions:
    """Grip the handle with the right hand, support the spout with the left, lift the kettle and tilt it."""
    # Water itself is not paid.
    kettle = hands.where("kettle/position")
    bucket = hands.where("bucket/position")
    back = hands.where("kettle/handle_position") - kettle  # from spout to handle
    back = back / back.norm()

    def grip(origin: Tensor, tilt: float = 0.0, aside: float = 0.0, loose: float = -0.003, steps: int = 1) -> Actions:
        """Lead the hands to where they hold a kettle at ``origin``, or ``loose`` metres off it, ``aside`` in x."""

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
    hands.bend("left", 0.0, 0.0, THJ4=1.047, THJ3=1.222)  # its thumb across the palm, off the kettle's wall
    yield from grip(kettle, aside=0.15, loose=0.025, steps=26)
    yield from grip(kettle, loose=0.025, steps=17)
    hands.bend("right", 1.2, 1.5)
    yield from grip(kettle, steps=17)
    sine = math.sin(_POUR)
    cosine = math.cos(_POUR)
    lip = -0.2 * cosine - 0.053 * sine, 0.053 * cosine - 0.2 * sine  # of a tilted kettle, along ``back`` and up
    way = bucket + (0.07 - lip[0]) * back - kettle
    way[2] += 0.098 - lip[1]
    for i in range(34):
        share = (i + 1) / 34
        there = kettle + share * way
        there[2] = kettle[2] + min(1.0, 1.3 * share) * way[2]  # up first: the left hand must clear the bucket's rim
        yield from grip(there, share * _POUR)
    yield from grip(kettle + way, _POUR, steps=hands.episode_steps)

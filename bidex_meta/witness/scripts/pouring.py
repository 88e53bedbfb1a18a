"""Scripts that pour water from a kettle into a bucket and, in version 2, then carry the bucket to its goal."""

import math

from torch import Tensor

from bidex_meta.hands.hand import SIDES
from bidex_meta.utils.maths import constant, rotate
from bidex_meta.witness.controller import Actions, HandController, Point, beside
from bidex_meta.witness.scripts.between import ramp
from bidex_meta.witness.scripts.buckets import BUCKET_STANDS, carry_bucket

# The first value is the rotation that lays the left fingers on the underside of the kettle's trough, the second the
# kettle's tilt in rad when it pours.
_TROUGH = math.radians(59.0)
_POUR = math.radians(50.0)
# Position in metres of the pouring kettle's lip relative to its origin: towards the handle, and up.
_LIP = -0.2 * math.cos(_POUR) - 0.053 * math.sin(_POUR), 0.053 * math.cos(_POUR) - 0.2 * math.sin(_POUR)
_OVER = 0.098  # height in metres of the lip above the bucket's origin
_THUMB = {"THJ4": 1.047, "THJ3": 1.222}  # the left thumb lies across the palm, away from the kettle's wall
# Distance in metres of the hands from the kettle before they take it, and while they hold it.
_LOOSE = 0.032
_FIRM = -0.003
# By how much the left hand of a grip is farther along x than the right one, metres, and the angle by which the line
# between the hands is lower at the right one if the kettle is upright, rad.
_AHEAD = 0.07
_SLOPE = 0.118
# Height in metres of a kettle on the table, height at which a kettle pours, and by how much it then rises while the
# water runs out: a kettle that is higher is empty.
_STANDS = 0.478
_POURS = BUCKET_STANDS + _OVER - _LIP[1]
_EMPTY = 0.039
_ASIDE = 0.2  # where the empty kettle is put down, y in metres
_INSIDE = 0.08  # a kettle with a larger y is on the way there


def pour_water(hands: HandController) -> Actions:
    """Grip handle and spout, lift the kettle and tilt it; for version 1."""
    # The reward ignores the water itself.
    kettle = hands.where("kettle/position")
    bucket = hands.where("bucket/position")
    back = hands.where("kettle/handle_position") - kettle  # from spout to handle
    back = back / back.norm()

    def grip(origin: Tensor, tilt: float = 0.0, shift: float = 0.0, loose: float = _FIRM, steps: int = 1) -> Actions:
        hands.hold("right", roll=tilt)
        hands.hold("left", roll=_TROUGH + tilt)
        right, left = (_grip(side, origin, back, tilt, loose, shift) for side in SIDES)
        yield from hands.lead(right, left, steps, speed=1.0)

    hands.bend("right", 0.0, 0.0)
    hands.bend("left", 0.0, 0.0, **_THUMB)
    yield from grip(kettle, shift=0.15, loose=0.025, steps=26)
    yield from grip(kettle, loose=0.025, steps=17)
    hands.bend("right", 1.2, 1.5)
    yield from grip(kettle, steps=17)
    way = bucket + (0.07 - _LIP[0]) * back - kettle
    way[2] += _OVER - _LIP[1]
    for i in range(34):
        share = (i + 1) / 34
        there = kettle + share * way
        there[2] = kettle[2] + min(1.0, 1.3 * share) * way[2]  # the left hand first rises, to clear the bucket's rim
        yield from grip(there, share * _POUR)
    yield from grip(kettle + way, _POUR, steps=hands.episode_steps)


def pour_and_carry(hands: HandController) -> Actions:
    """Pour, put the kettle down at the side, and carry the bucket to its goal; for version 2.

    The present state alone says what comes next. A kettle that is tilted over the bucket rises while the water runs
    out; above a height it is empty, is turned upright, and goes aside and down. Both hands let go of a kettle that
    stands there.
    """
    while hands.steps_left:
        kettle = hands.where("kettle/position")
        turn = hands.orientation("kettle/quaternion")
        back = rotate(turn, constant((1.0, 0.0, 0.0), turn))  # from spout to handle
        tilt = math.asin(max(-1.0, min(1.0, float(back[2]))))
        back[2] = 0.0
        back /= back.norm() + 1e-9
        off = {side: hands.at(side) - _tensor(_grip(side, kettle, back, tilt, 0.0), kettle) for side in SIDES}
        y = float(kettle[1])
        if y < 0.12 or abs(tilt) > 0.16 or kettle[2] > _STANDS + 0.035:
            yield from _use_kettle(hands, kettle, back, tilt, off)
        elif any(off[side][0] < 0.14 and off[side][2] < 0.075 and hands.at(side)[1] > y - 0.22 for side in SIDES):
            hands.bend("right", 0.0, 0.0)
            hands.bend("left", 0.0, 0.0, **_THUMB)
            hands.hold("right")
            hands.hold("left", roll=_TROUGH)
            bent = float(hands.where("right/FFJ1_position"))
            out = 0.2 * ramp(bent, 0.5, 0.3)
            yield from hands.lead_each((_grip(side, kettle, back, 0.0, 0.025, out) for side in SIDES), 1.0)
        else:
            yield from carry_bucket(hands)


def _use_kettle(hands: HandController, kettle: Tensor, back: Tensor, tilt: float, off: dict[str, Tensor]) -> Actions:
    """Take the kettle, or carry it on if the hands hold it.

    ``back`` (3,) is the horizontal direction from spout to handle, ``tilt`` the kettle's tilt towards the spout, rad.
    ``off`` are the ways (3,) from the places at which the hands hold the kettle to the hands' points, metres.
    """
    shift = {}
    ready = 1.0
    for side in SIDES:
        x, y, z = off[side].tolist()
        if side == "right":
            y -= 0.005
            far = math.hypot(y, z)
        else:
            z += 0.026  # the left hand comes from below, and then rises to the trough
            far = math.hypot(y, max(0.0, z - 0.035) + min(0.0, z + 0.01))
        inside = max(ramp(math.hypot(y, z), 0.012, 0.007), ramp(x, 0.06, 0.03) * ramp(far, 0.05, 0.035))
        shift[side] = 0.15 * (1.0 - inside)
        ready *= ramp(abs(x), 0.024, 0.012) * ramp(far, 0.035, 0.02)
    slip = max(float(off[side].norm()) for side in SIDES)
    ready = max(ready, ramp(float(hands.where("right/FFJ2_position")), 0.45, 0.6) * ramp(slip, 0.07, 0.05))
    loose = _LOOSE + ready * (_FIRM - _LOOSE)
    hands.bend("right", 1.45 * ready, 1.57 * ready)
    hands.bend("left", 0.0, 0.0, **_THUMB)
    held = ready * ramp(float(hands.where("right/FFJ1_position")), 0.85, 0.97)
    # As soon as they hold the kettle, the hands follow each other and not the kettle, which may slip between them.
    line = hands.at("right") - hands.at("left")
    line[0] += _AHEAD
    flat = float(line[:2].norm())
    line[:2] /= flat + 1e-9
    now = math.atan2(float(line[2]), flat) + _SLOPE
    line[2] = 0.0
    step, lead = _next(hands, kettle, back, tilt)
    places = [_tensor(_grip(side, 0.0 * kettle, line, now, loose), kettle) for side in SIDES]
    between = 0.5 * sum(hands.at(side) - place for side, place in zip(SIDES, places, strict=True))
    follow = ramp(held, 0.3, 0.7)
    origin = kettle + follow * (between + held * step - kettle)
    tilt = tilt + follow * (now + lead - tilt)
    back = back + follow * (line - back)
    back /= back.norm() + 1e-9
    hands.hold("right", roll=tilt)
    hands.hold("left", roll=_TROUGH + tilt)
    yield from hands.lead_each((_grip(side, origin, back, tilt, loose, shift[side]) for side in SIDES), 1.0)


def _next(hands: HandController, kettle: Tensor, back: Tensor, tilt: float) -> tuple[Tensor, float]:
    """Return the next way (3,) of a kettle that is held, metres, and its next turn towards the spout, rad.

    ``back`` (3,) is the horizontal direction from spout to handle, ``tilt`` the kettle's tilt towards the spout, rad.
    """
    bucket = hands.where("bucket/position")
    x, y, z = kettle.tolist()
    up = z - _STANDS
    over = bucket + 0.05 * back - hands.where("kettle/spout_position")
    over[2] = 0.0
    far = float(over.norm())
    over *= ramp(up, 0.03, 0.1) * min(1.0, 0.035 / (far + 1e-9))
    pours = ramp(tilt, _POUR - 0.16, _POUR - 0.08)
    over[2] = pours * 0.02 * ramp(far, 0.04, 0.02) + (1.0 - pours) * max(-0.035, min(0.035, _POURS - z))
    aside = kettle.new_tensor([float(bucket[0]) - x, _ASIDE - y, 0.0])
    aside *= ramp(tilt, 0.6, 0.3) * min(1.0, 0.045 / (float(aside.norm()) + 1e-9))
    high = _POURS + _EMPTY + 0.026
    aside[2] = max(-0.05, min(0.035, high + (_STANDS - 0.01 - high) * ramp(y, 0.1, 0.17) - z))
    # The empty kettle passes from the first way into the second one gradually.
    empty = max(ramp(z - _POURS, _EMPTY - 0.005, _EMPTY + 0.005), ramp(y, _INSIDE - 0.02, _INSIDE + 0.02))
    way = over + empty * (aside - over)
    turn = (1.0 - empty) * _POUR * ramp(up, 0.0, 0.9 * (_POURS - _STANDS)) - tilt
    return way, max(-0.18, min(0.12, turn))


def _grip(side: str, origin: Tensor, back: Tensor, tilt: float, loose: float, shift: float = 0.0) -> Point:
    """Return the place at which a hand holds a kettle, world, metres.

    ``origin`` (3,) is the kettle's origin, ``back`` (3,) the horizontal direction from spout to handle, and ``tilt``
    its tilt towards the spout, rad. The hand keeps a distance of ``loose`` metres from the kettle, or presses it if
    ``loose`` is negative. It is shifted by ``shift`` metres along x.
    """
    if side == "right":
        x = -0.005
        along = 0.159 + 0.2 * loose
        up = -0.004
    else:
        x = 0.065
        along = -0.153
        up = 0.030 - loose
    flat = along * math.cos(tilt) - up * math.sin(tilt)
    rise = along * math.sin(tilt) + up * math.cos(tilt)
    return beside(origin + flat * back, x + shift, 0.0, float(origin[2]) + rise)


def _tensor(place: Point, like: Tensor) -> Tensor:
    return like.new_tensor(place)

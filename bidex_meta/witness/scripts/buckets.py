"""A step of a scripted policy in which two palms clamp a bucket and carry it to its goal."""

from torch import Tensor

from bidex_meta.hands.hand import SIDES
from bidex_meta.witness.controller import Actions, HandController, point
from bidex_meta.witness.scripts.between import ramp

BUCKET_STANDS = 0.457
"""Height in metres of the origin of a bucket on the table."""

# These values are in metres.
_AHEAD = 0.03  # offset of the hands' points from the bucket along x
_UP = 0.03  # height of the hands' points above a standing bucket's origin; below, the left thumb would touch the table
_OVER = 0.18  # how much higher the hands pass over the bucket
_LIFT = 0.012
_APART = 0.13  # half the distance of the hands before they close
_SIGNS = (1.0, -1.0)  # sides of the bucket along y on which the right and the left hand are


def carry_bucket(hands: HandController) -> Actions:
    """Clamp the bucket between both palms, carry it to its goal and hold it there: one step, from the present state."""
    # The thumbs are moved out of the way. The left thumb points down, so it is bent.
    hands.bend("right", 0.3, 0.0, THJ4=-1.047)
    hands.bend("left", 0.3, 0.0, THJ4=-1.047, THJ1=-0.5, THJ0=-1.57)
    for side in SIDES:
        hands.hold(side)
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
    rest = hands.frozen("goal")[:3] - bucket
    far = float(rest[:2].norm())
    rest *= held * min(1.0, 0.04 / (far + 1e-9))
    rest[2] = BUCKET_STANDS + _UP - bucket[2] + held * _LIFT * ramp(far, 0.01, 0.02)
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

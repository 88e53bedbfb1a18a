"""Scripted policies for the four door classes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from bidex_meta.hands.hand import SIDES
from bidex_meta.witness.controller import Actions, HandController, Point

_ABOVE = 1.0  # height at which a hand is clear of the bars, metres
_DOOR_HEIGHT = 0.72  # height of the hands at a door, between the ends of the bars, metres
# Offset from a hand's point to the middle joints of its fingers: ahead, and away from where the palm faces, metres.
_TO_FINGERS = 0.06
_TO_PALM = 0.02


@dataclass(frozen=True)
class _Leaf:
    """Geometry of one door leaf, seen from above. Lengths are in metres.

    The values come from assets/objects/door.xml. They are written for a leaf on the right hand's side, where y points
    outwards from the middle of the door. ``hinge`` holds the hinge's x and y. ``along`` and ``over`` give the position,
    relative to the hinge, of the handle bar that faces the hands: ``along`` is the distance along the leaf, and
    ``over`` is the distance perpendicular to the leaf.
    """

    hinge: tuple[float, float]
    along: float
    over: float

    def place(self, along: float, over: float, angle: float) -> tuple[float, float]:
        """Return x and y of a point on the leaf, for a leaf that is open towards the hands by an angle, rad.

        A negative angle means that the leaf is open away from the hands.
        """
        sine = math.sin(angle)
        cosine = math.cos(angle)
        return self.hinge[0] + over * cosine + along * sine, self.hinge[1] + over * sine - along * cosine


_INWARD = _Leaf((0.0085, 0.4265), 0.3752, 0.0710), _Leaf((0.0056, 0.4204), 0.3761, 0.0738)
_OUTWARD = _Leaf((-0.0085, 0.4265), 0.3752, 0.0830), _Leaf((-0.0056, 0.4204), 0.3761, 0.0802)


def open_inward(hands: HandController) -> Actions:
    """Put bent fingers behind the bars of both door handles from the side, and pull the leaves open.

    The hands turn with the leaves.
    """
    # One open and one shut leaf earn as much reward as two half-open leaves.

    def go(
        angles: Sequence[float], aside: float = 0.0, back: float = 0.0, steps: int = 1, speed: float = 0.6
    ) -> Actions:
        """Move the bent fingers behind the handle bars of leaves that are open towards the hands by ``angles``, rad.

        From there the fingers are shifted by ``aside`` metres towards the hinge, and by ``back`` metres away from the
        leaf.
        """
        pairs = zip(_INWARD, angles, strict=True)
        at = [leaf.place(leaf.along - 0.009 - aside, leaf.over + 0.01 + back, angle) for leaf, angle in pairs]
        yield from _lead(hands, at, angles, steps, speed)

    for side in SIDES:
        hands.bend(side, 0.0, 1.45)
    led = _angles(hands)
    yield from go(led, aside=0.11, back=0.02, steps=22, speed=0.8)
    yield from go(led, aside=0.11, steps=6, speed=0.5)
    yield from go(led, steps=15, speed=0.5)
    while hands.steps_left:
        triples = zip(led, _angles(hands), _goals(hands, 1.35), strict=True)
        led = [min(angle + 0.0075, now + 0.1, last) for angle, now, last in triples]
        yield from go(led)


def close_outward(hands: HandController) -> Actions:
    """Put straight fingers between each door leaf and the bar of its handle, and pull the leaves shut.

    The hands turn with the leaves.
    """
    # Leaves that stand away from the hands cannot be pushed shut. The distance between hand and leaf is bounded,
    # because more force straightens bent fingers.
    start = _angles(hands)

    def go(angles: Sequence[float], back: float = 0.0, steps: int = 1, speed: float = 0.6) -> Actions:
        """Move the fingers behind the handle bars of leaves that are open away from the hands by ``angles``, rad.

        From there the hands are shifted by ``back`` metres, against the direction in which they point.
        """
        yaws = [1.2 * (first - angle) for first, angle in zip(start, angles, strict=True)]
        at = []
        for leaf, angle, yaw in zip(_OUTWARD, angles, yaws, strict=True):
            x, y = leaf.place(leaf.along, leaf.over - 0.04, -angle)
            ahead = _TO_FINGERS + back
            sine = math.sin(yaw)
            cosine = math.cos(yaw)
            at.append((x + ahead * cosine + _TO_PALM * sine, y + ahead * sine - _TO_PALM * cosine))
        yield from _lead(hands, at, yaws, steps, speed)

    for side in SIDES:
        hands.bend(side, 0.0, 0.0)
    yield from go(start, back=0.2, steps=10, speed=1.6)
    yield from go(start, steps=10, speed=1.6)
    led = start
    lasts = _goals(hands, -0.2, 0.1)  # a finger has this clearance
    while hands.steps_left:
        triples = zip(led, _angles(hands), lasts, strict=True)
        led = [max(angle - 0.012, now - 0.22, last) for angle, now, last in triples]
        yield from go(led)


def push(hands: HandController) -> Actions:
    """Push each door leaf to its target angle with a fist above the handle's bar, and then let go of the leaf."""
    # Both classes that push turn a leaf the same way: from open towards the hands over shut to open away from them.
    inward = abs(float(hands.orientation("object/quaternion")[1])) > 0.5
    if inward:
        leaves = _INWARD
        sign = 1.0
        usual = -0.1  # the leaves are shut
    else:
        leaves = _OUTWARD
        sign = -1.0
        usual = 1.35
    goals = [sign * goal for goal in _goals(hands, usual)]

    def go(angles: Sequence[float], back: float, steps: int = 1, speed: float = 0.6) -> Actions:
        """Move the fists to the places where they touch leaves that are open towards the hands by ``angles``, rad.

        From there the fists are shifted by ``back`` metres away from the leaves.
        """
        at = [leaf.place(0.33, 0.06 + back, angle) for leaf, angle in zip(leaves, angles, strict=True)]
        yield from _lead(hands, at, [0.0, 0.0], steps, speed, height=_ABOVE)

    for side in SIDES:
        hands.bend(side, 1.4, 1.4, THJ3=0.5, THJ0=-1.2)
    led = [sign * angle for angle in _angles(hands)]
    yield from go(led, back=0.1, steps=30, speed=1.2)
    while hands.steps_left:
        now = [sign * angle for angle in _angles(hands)]
        left = [angle - goal for angle, goal in zip(now, goals, strict=True)]
        triples = zip(led, now, left, strict=True)
        led = [max(was - 0.012, angle - 0.3) if more > 0.04 else angle + 0.1 for was, angle, more in triples]
        yield from go(led, back=0.0)


def _goals(hands: HandController, usual: float, less: float = 0.0) -> list[float]:
    """Return the target angles of the right and the left leaf, each reduced by ``less``, rad.

    If the task has no target angles, return ``usual`` for both leaves.
    """
    if hands.wide:
        return (hands.frozen("leaves") - less).tolist()
    return [usual, usual]


def _angles(hands: HandController) -> list[float]:
    """Return the angles by which the right and the left leaf are open, rad."""
    return [float(hands.where(f"object/hinge{leaf}_angle")) for leaf in (1, 2)]


def _lead(
    hands: HandController,
    at: Sequence[tuple[float, float]],
    yaws: Sequence[float],
    steps: int,
    speed: float,
    height: float = _DOOR_HEIGHT,
) -> Actions:
    """Move each hand to its point in ``at``, and turn it outwards by its angle in ``yaws``, rad.

    A point is x and y in metres, where y points outwards from the middle of the door. ``height`` is the point's height.
    """
    middle = float(hands.where("object/position")[1])
    points: list[Point] = []
    for side, sign, (x, y), yaw in zip(SIDES, (1.0, -1.0), at, yaws, strict=True):
        hands.hold(side, yaw=sign * yaw)
        points.append((x, middle + sign * y, height))
    yield from hands.lead(*points, steps=steps, speed=speed)

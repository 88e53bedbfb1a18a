"""Scripts for the two door classes whose pulls must be pulled; the leaves of the others are pushed.

DoorOpenInward: one leaf open and the other shut pays as much as both half open. DoorCloseOutward: leaves that stand
away from the hands cannot be pushed shut. Fingers behind each leaf's bar lead it along its circle. How far a hand may
be ahead of its leaf is bounded: more force straightens bent fingers.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from bidex_meta.hands.pair import SIDES
from bidex_meta.witness.puppets import Point, Puppets

_HEIGHT = 0.72
"""Of the hands, between the ends of the bars, metres."""
_TO_FINGERS, _TO_PALM = 0.06, 0.02
"""From a hand's point to its fingers' middle joints: ahead, and away from where the palm faces, metres."""


@dataclass(frozen=True)
class _Leaf:
    """A leaf from above, as on the right hand's side, where y grows outwards; metres (assets/objects/door.xml).

    Attributes:
        hinge: Its x, and its y from the door's middle.
        along: From the hinge to the bar that faces the hands, along the leaf.
        over: From the hinge to that bar, across the leaf.
    """

    hinge: tuple[float, float]
    along: float
    over: float

    def place(self, along: float, over: float, angle: float) -> tuple[float, float]:
        """Where a point of the leaf is that stands open by so much towards the hands (away from them: negative)."""
        sine, cosine = math.sin(angle), math.cos(angle)
        return self.hinge[0] + over * cosine + along * sine, self.hinge[1] + over * sine - along * cosine


_INWARD = _Leaf((0.0085, 0.4265), 0.3752, 0.0710), _Leaf((0.0056, 0.4204), 0.3761, 0.0738)
_OUTWARD = _Leaf((-0.0085, 0.4265), 0.3752, 0.0830), _Leaf((-0.0056, 0.4204), 0.3761, 0.0802)


def open_inward(hands: Puppets) -> None:
    """Fingers bent to hooks go behind the bars from the side, and pull the leaves open; the hands turn with them."""

    def go(angles: Sequence[float], aside: float = 0.0, back: float = 0.0, steps: int = 1, speed: float = 0.6) -> None:
        """Hooks behind the bars of leaves that stand open by these angles, or ``aside`` and ``back`` of that."""
        at = [
            leaf.place(leaf.along - 0.009 - aside, leaf.over + 0.01 + back, angle)
            for leaf, angle in zip(_INWARD, angles, strict=True)
        ]
        _lead(hands, at, angles, steps, speed)

    for side in SIDES:
        hands.bend(side, 0.0, 1.45)
    led = _angles(hands)
    go(led, aside=0.11, back=0.02, steps=22, speed=0.8)
    go(led, aside=0.11, steps=6, speed=0.5)
    go(led, steps=15, speed=0.5)
    while len(hands.actions) < hands.episode_steps:
        led = [min(angle + 0.0075, now + 0.1, 1.35) for angle, now in zip(led, _angles(hands), strict=True)]
        go(led)


def close_outward(hands: Puppets) -> None:
    """Straight fingers go between each bar and its leaf, and pull the leaves shut; the hands turn with them."""
    start = _angles(hands)

    def go(angles: Sequence[float], back: float = 0.0, steps: int = 1, speed: float = 0.6) -> None:
        """Fingers behind the bars of leaves that stand open by these angles, or ``back`` of that."""
        yaws = [0.8 * (first - angle) for first, angle in zip(start, angles, strict=True)]
        at = []
        for leaf, angle, yaw in zip(_OUTWARD, angles, yaws, strict=True):
            x, y = leaf.place(leaf.along, leaf.over - 0.04, -angle)
            ahead, sine, cosine = _TO_FINGERS + back, math.sin(yaw), math.cos(yaw)
            at.append((x + ahead * cosine + _TO_PALM * sine, y + ahead * sine - _TO_PALM * cosine))
        _lead(hands, at, yaws, steps, speed)

    for side in SIDES:
        hands.bend(side, 0.0, 0.0)
    go(start, back=0.2, steps=16, speed=1.0)
    go(start, steps=22, speed=1.2)
    led = start
    while len(hands.actions) < hands.episode_steps:
        led = [max(angle - 0.012, now - 0.22, -0.2) for angle, now in zip(led, _angles(hands), strict=True)]
        go(led)


def _angles(hands: Puppets) -> list[float]:
    """How far the right and the left leaf stand open, rad."""
    return [float(hands.where(f"object/hinge{leaf}_angle")) for leaf in (1, 2)]


def _lead(hands: Puppets, at: Sequence[tuple[float, float]], yaws: Sequence[float], steps: int, speed: float) -> None:
    """Leads both hands to places on the right hand's side, the left one to its place mirrored, turned outwards."""
    middle = float(hands.where("object/position")[1])
    points: list[Point] = []
    for side, sign, (x, y), yaw in zip(SIDES, (1.0, -1.0), at, yaws, strict=True):
        hands.hold(side, yaw=sign * yaw)
        points.append((x, middle + sign * y, _HEIGHT))
    hands.lead(*points, steps=steps, speed=speed)

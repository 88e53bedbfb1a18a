"""Steps of scripted policies in which two hands hold an object between them and carry it.

The hands are on both sides of the object along y. Every step is a function of the present state, and changes little
when the state changes little. A policy without memory can therefore learn the steps, and a policy that is late or drops
the object can continue.
"""

import math
from dataclasses import dataclass

from torch import Tensor

from bidex_meta.hands.hand import SIDES
from bidex_meta.witness.controller import HandController, Point, point


@dataclass(frozen=True)
class Take:
    """Parameters for taking an object between two hands. Lengths are in metres.

    Attributes:
        ahead: Offset along x from the object to the points of the hands; ``above``: their offset along z.
        high: Height at which the hands' points pass over all objects.
        apart: Distance along y from the object to each hand's point before the hands close.
        aim: Largest horizontal distance between the midpoint of the hands and its target while the hands go down.
        joints: For the right and the left hand, one joint that gives way when the hand presses the object.
        free: Angles of these two joints while the hands touch nothing, rad.
        firm: Angles of these two joints while the hands hold the object firmly, rad.
        press: How far the hands close: until the joints have moved by this multiple of the way from ``free`` to
            ``firm``. The forces on the bases are not used for this, because one newton is only 0.1 to 0.3 % of a base's
            range, so the hold would be too hard or too loose.
    """

    ahead: float
    above: float
    high: float
    apart: float
    aim: float
    joints: tuple[str, str]
    free: tuple[float, float]
    firm: tuple[float, float]
    press: float = 1.0


_CLOSING = 0.015  # distance by which the target leads a hand that does not press yet, metres


def ramp(value: float, first: float, last: float) -> float:
    """Return a number that is 0 for values up to ``first``, rises linearly, and is 1 for values from ``last`` upwards.

    If ``last`` is less than ``first``, the number is 1 for low and 0 for high values.
    """
    return min(1.0, max(0.0, (value - first) / (last - first)))


def blend(share: float, first: tuple[Point, Point], second: tuple[Point, Point]) -> tuple[Point, Point]:
    """Return target points of both hands: ``first`` for a share of 1, ``second`` for 0, and points between for others.

    A script that jumps from one step to the next teaches badly: near the jump, a network's answer is a mean of both.
    """

    def between(a: Point, b: Point) -> Point:
        x, y, z = (share * p + (1.0 - share) * q for p, q in zip(a, b, strict=True))
        return x, y, z

    return between(first[0], second[0]), between(first[1], second[1])


class Between:
    """Both hands and an object that they take, in their present state."""

    def __init__(self, hands: HandController, thing: str, take: Take, room: tuple[float, float] = (1.0, 1.0)) -> None:
        """Read the present state of the hands and of the object called ``thing``.

        ``take`` says how the hands take the object. ``room`` limits the distances from the object to the right and the
        left hand's point before the hands close, metres. The distances are smaller than ``take.apart`` if there is less
        room.
        """
        right, left = (min(take.apart, each) for each in room)
        self.take = take
        self.apart = 0.5 * (right + left)
        self.right, self.left = (point(hands.at(side)) for side in SIDES)
        self.thing = x, y, z = point(hands.where(f"{thing}/position"))
        self.half = 0.5 * (self.right[1] - self.left[1])
        self.middle = tuple(0.5 * (a + b) for a, b in zip(self.right, self.left, strict=True))
        aside = 0.5 * (right - left) * ramp(self.half, self.apart - 0.02, self.apart - 0.005)
        self.way = x + take.ahead - self.middle[0], y + aside - self.middle[1]
        self.off = math.hypot(*self.way)
        self.over = self.middle[2] - z - take.above
        shares = []
        for side, joint, free, firm in zip(SIDES, take.joints, take.free, take.firm, strict=True):
            shares.append((float(hands.where(f"{side}/{joint}_position")) - free) / (firm - free))
        self.firm = min(shares)
        near = (
            ramp(self.off, 0.05, 0.03)
            * ramp(abs(self.over), 0.05, 0.035)
            * ramp(self.half, self.apart + 0.01, self.apart)
        )
        self.held = near * ramp(self.firm, 0.15, 0.35)

    def far(self, goal: Tensor) -> float:
        """Return the horizontal distance of the object from ``goal``, metres."""
        return math.hypot(float(goal[0]) - self.thing[0], float(goal[1]) - self.thing[1])

    def carry(self, goal: Tensor, carried: float, lowered: float) -> tuple[Point, Point]:
        """Return the next target points of both hands, right then left, to take the object to ``goal`` and set it down.

        The object travels at the height ``carried`` and is set down at the height ``lowered``, metres.
        """
        aside = self._get()
        held = self._bring(goal, carried, lowered)
        x, y, z, half = (a + self.held * (b - a) for a, b in zip(aside, held, strict=True))
        return self._points(x, y, z, half)

    def leave(self) -> tuple[Point, Point]:
        """Return the next target points of both hands, right then left, to let go of the object and then go up."""
        x, y, _ = self.middle
        return self._points(x, y, self._rise(self.take.high), self.apart)

    @staticmethod
    def _points(x: float, y: float, z: float, half: float) -> tuple[Point, Point]:
        return (x, y + half, z), (x, y - half, z)

    def _rise(self, height: float) -> float:
        """Return the next height of the hands on the way to ``height``, metres.

        The hands go up only when they are apart, so that they do not lift anything.
        """
        way = height - self.middle[2]
        apart = ramp(self.half, self.apart - 0.02, self.apart - 0.005)
        return self.middle[2] + way * (apart if way > 0.0 else 1.0)

    def _close(self) -> float:
        """Return half of the distance that the hands should have in the next step, metres.

        The hands come closer until they hold the object firmly.
        """
        press = self.take.press
        return self.half - _CLOSING * (press - min(press + 1.0, self.firm))

    def _get(self) -> tuple[float, float, float, float]:
        """Return the next targets, x, y and z of the hands' midpoint and half the hands' distance, to take the object.

        The hands go from above to both sides of the object. Then they close until they hold it.
        """
        take = self.take
        x, y, height = self.middle
        near = max(ramp(self.off, 0.06, 0.04), ramp(height, take.high - 0.03, take.high - 0.01))
        low = self.thing[2] + take.above
        over = self._rise(low + (take.high - low) * ramp(self.off, take.aim, take.aim + 0.03))
        close = ramp(self.off, take.aim + 0.018, take.aim + 0.003) * ramp(self.over, 0.035, 0.015)
        half = self.apart + close * (self._close() - self.apart)
        return x + near * self.way[0], y + near * self.way[1], over, half

    def _bring(self, goal: Tensor, carried: float, lowered: float) -> tuple[float, float, float, float]:
        """Return the next targets, x, y and z of the hands' midpoint and half the hands' distance, to carry the object.

        The hands carry the object over ``goal`` at the height ``carried``, and then lower it to the height ``lowered``.
        """
        x, y, height = self.middle
        way = float(goal[0]) - self.thing[0], float(goal[1]) - self.thing[1]
        far = math.hypot(*way)
        up = self.thing[2]
        share = max(ramp(up, carried - 0.012, carried - 0.004), ramp(far, 0.02, 0.012)) * min(1.0, 0.04 / (far + 1e-9))
        wanted = lowered + (carried - lowered) * ramp(far, 0.007, 0.018)
        rise = max(-0.03, min(0.03, wanted - up)) * ramp(self.firm, 0.4, 0.8)
        return x + share * way[0], y + share * way[1], height + rise, self._close()

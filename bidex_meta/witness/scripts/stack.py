"""Scripted policy of version 2 for two blocks that are stacked at a given place in a given order."""

import math

from torch import Tensor

from bidex_meta.hands.hand import SIDES
from bidex_meta.witness.controller import Actions, HandController, beside
from bidex_meta.witness.scripts.between import around, clamp, middle, move, reach

# Heights of the hands' points with fingers that point down: their tips 1 cm above the table, and above the blocks.
_LOW, _HIGH = 0.690, 0.765
# From a block's middle to the hands' points before they close on it, and where they touch it; from these points to the
# fingers, metres.
_APART, _TOUCH, _AHEAD = 0.085, 0.052, 0.017
# Distance inside a block to which a hand is led where it lifts it, metres: about 12 N. Less lets the block slip, more
# turns the hands, whose torque is weak; then they push the stack over as they let go.
_PRESS = 0.003


def stack_in_order(hands: HandController) -> Actions:
    """The backs of both hands' fingers clamp the lower block, carry it to its target, and put the other on it."""
    upper, lower = ("block1", "block2") if float(hands.frozen("upper")) > 0.0 else ("block2", "block1")
    for side in SIDES:
        hands.hold(side)
    for _ in range(7):  # up, before the fingers swing down
        yield from hands.lead_each(beside(hands.at(side), 0.0, 0.0, _HIGH) for side in SIDES)
    for side in SIDES:
        hands.bend(side, 1.57, 0.0)
    yield from _carry(hands, lower, upper, 0.0)
    yield from _carry(hands, upper, lower, 0.075)
    while hands.steps_left:
        yield from hands.lead_each(beside(hands.at(side), 0.0, 0.0, _LOW + 0.05) for side in SIDES)


def _carry(hands: HandController, block: str, other: str, lift: float) -> Actions:
    """Takes a block to its target, lifted so high; the inner hand's fingers go between the blocks."""
    goal, place = hands.frozen(f"goal{block[-1]}"), hands.where(f"{block}/position")
    beyond, gap, _ = (hands.where(f"{other}/position") - place).tolist()
    sides = {1.0: _APART, -1.0: _APART}
    if abs(beyond) < 0.075:
        sides[math.copysign(1.0, gap)] = max(_TOUCH + 0.003, min(_APART, 0.5 * abs(gap) + _AHEAD))

    def beside_it(height: float, steps: int) -> Actions:
        x, y = place[:2].tolist()
        right, left = (x, y + sides[1.0], height), (x, y - sides[-1.0], height)
        yield from reach(hands, right, left, steps)

    yield from beside_it(_HIGH, 40)
    yield from beside_it(_LOW, 20)
    yield from around(hands, place, 0.0, _TOUCH + 0.006, _LOW, 10)
    yield from _grip(hands, place)
    for _ in range(20):
        if float(hands.where(f"{block}/position")[2]) > float(goal[2]) + 0.012 or not lift:
            break
        yield from clamp(hands, place, _LOW + lift, press=_PRESS)
    yield from move(hands, f"{block}/position", goal, _LOW + lift, 0.05, press=0.6 * _PRESS)
    if lift:
        yield from clamp(hands, middle(hands), _LOW + 0.05, 10, press=0.3 * _PRESS)
        yield from around(hands, middle(hands), 0.0, 2 * _TOUCH, _LOW + 0.05, 20)
    else:
        where = middle(hands)
        yield from around(hands, where, 0.0, _TOUCH + 0.014, _LOW, 6)
        yield from around(hands, where, 0.0, _TOUCH + 0.014, _HIGH, 10)


def _grip(hands: HandController, place: Tensor) -> Actions:
    """Closes the hands until the block between them stops them."""
    wide: list[float] = []
    for _ in range(30):
        wide.append(float((hands.at("right") - hands.at("left"))[1]))
        if len(wide) > 8 and wide[-4] - wide[-1] < 0.002:
            break
        yield from clamp(hands, place, _LOW, press=0.008)

"""Scripted policy that stacks two blocks at a given place, and in version 2 in a given order."""

from bidex_meta.hands.hand import SIDES
from bidex_meta.witness.controller import Actions, HandController
from bidex_meta.witness.scripts.between import Between, Take, blend, ramp

# This is the bend of the knuckles in rad. The fingers point down and yield when their backs press a block. A force of
# 2 N is enough; a larger one would turn the hands, whose torque is low.
_BENT = 1.3
_FIRM = 1.4
_TAKE = Take(0.0, 0.065, 0.765, 0.097, 0.012, ("MFJ2", "MFJ2"), (_BENT, _BENT), (_FIRM, _FIRM))
# These lengths in metres are the height of a block on the table, and a block's edge.
_LIES = 0.629
_EDGE = 0.05


def stack_in_order(hands: HandController) -> Actions:
    """Clamp the lower block with the backs of both hands' fingers, carry it, and stack the other block on it."""
    if hands.wide and float(hands.frozen("upper")) < 0.0:
        upper = "block2"
        lower = "block1"
    else:
        upper = "block1"
        lower = "block2"
    goals = {block: hands.frozen(f"goal{block[-1]}") for block in (upper, lower)}
    for side in SIDES:
        hands.hold(side)
    while hands.steps_left:
        for side in SIDES:  # the hands rise before the fingers swing down
            knuckle = float(hands.where(f"{side}/MFJ2_position"))
            height = float(hands.at(side)[2])
            hands.bend(side, _BENT * max(ramp(height, 0.72, 0.75), ramp(knuckle, 0.3, 0.6)), 0.0)
        below = _between(hands, lower, upper)
        above = _between(hands, upper, lower)
        top = below.thing[2] + _EDGE
        # Each step passes into the next one gradually, so that a network can learn them.
        off_goal = ramp(below.far(goals[lower]), 0.022 - 0.014 * below.held, 0.032 - 0.018 * below.held)
        off_block = max(
            ramp(above.far(hands.where(f"{lower}/position")), 0.018, 0.026), ramp(above.thing[2] - top, 0.003, 0.007)
        )
        put = blend(off_block, above.carry(goals[upper], top + 0.02, top + 0.003), above.leave())
        points = blend(off_goal, below.carry(goals[lower], _LIES, _LIES), put)
        yield from hands.lead_each(points)


def _between(hands: HandController, block: str, other: str) -> Between:
    """Return the present state of the hands and of the block that they take.

    If the ``other`` block is near, the hand on that side keeps closer to the taken block until the hands close.
    """
    x, y, _ = (hands.where(f"{other}/position") - hands.where(f"{block}/position")).tolist()
    if abs(x) < 0.075:
        room = max(0.08, min(_TAKE.apart, abs(y) - 0.025))
    else:
        room = _TAKE.apart
    return Between(hands, block, _TAKE, (room, _TAKE.apart) if y > 0.0 else (_TAKE.apart, room))

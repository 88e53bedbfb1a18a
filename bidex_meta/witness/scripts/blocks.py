"""Scripted policy that pushes blocks on a table."""

from bidex_meta.hands.hand import SIDES
from bidex_meta.witness.controller import Actions, HandController, beside

_DOWN = 0.2  # bend of the wrist, rad, that brings straight fingers below the forearm


# A fork of forefinger and little finger: distances from the block to the hand's point while it pushes and while it lets
# go of the block, height above the floor, and joint angles that spread the fork. Metres, rad.
_BEHIND = 0.06
_CLEAR = 0.09
_LOW = 0.642
_FORK = {"FFJ3": 0.3, "LFJ3": -0.3, "MFJ2": 1.4, "MFJ1": 1.4, "RFJ2": 1.4, "RFJ1": 1.4}


def push_blocks(hands: HandController) -> Actions:
    """Take each block between forefinger and little finger of one hand and push it to its goal."""
    blocks = {"right": "block2", "left": "block1"}
    goals = {"right": "goal2", "left": "goal1"}
    for side in SIDES:
        hands.bend(side, 0.0, 0.0, THJ3=0.5, THJ1=-0.5, THJ0=-1.5, WRJ0=_DOWN, **_FORK)
        hands.hold(side)

    def behind(x: float, height: float, steps: int, speed: float) -> Actions:
        for _ in range(steps):
            at = (hands.where(f"{blocks[side]}/position") for side in SIDES)
            yield from hands.lead_each((beside(each, x, 0.0, height) for each in at), speed)

    yield from behind(0.16, 0.68, 20, 1.6)
    yield from behind(0.15, _LOW, 8, 1.0)
    yield from behind(_BEHIND + 0.01, _LOW, 15, 0.6)
    while hands.steps_left:
        points = []
        for side in SIDES:
            place = hands.where(f"{blocks[side]}/position")
            way = hands.frozen(goals[side])[:2] - place[:2]
            far = float(way.norm())
            if far > 0.05:
                lead = way * (0.05 / far)
            elif far < 0.01:
                lead = way * 0.0
            else:
                lead = way * 1.0
            # The fork is at this position if it follows its block; it never runs ahead.
            ahead = float(lead[0])
            behind_block = _BEHIND + ahead if ahead < -0.004 else _CLEAR
            points.append(beside(place, behind_block, float(lead[1]), _LOW))
        yield from hands.lead_each(points, 0.5)

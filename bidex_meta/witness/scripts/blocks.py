"""Scripted policies for blocks on a table."""

from bidex_meta.hands.hand import SIDES
from bidex_meta.witness.controller import Actions, HandController, beside

_FINGERS = 0.085  # from a hand's point to the tips of its bent fingers, metres
_DOWN = 0.2  # bend of the wrist that brings straight fingers below the forearm, rad
_PRESS = 0.0015  # distance inside what a hand presses to which it is led, metres: about 6 N


def grasp_and_place(hands: HandController) -> Actions:
    """Both hands clamp the block between the right forefinger and the left little finger, and drop it in the bucket."""
    # The reward for the block's nearness is flat where the block starts, and a push pays only after the hand has
    # followed.
    block, bucket = hands.where("block/position"), hands.where("bucket/position")
    hands.bend("right", 0.0, 0.0, THJ3=0.5, THJ1=-0.5, THJ0=-1.5, WRJ0=_DOWN)  # its thumb out of the way
    hands.bend("left", 0.0, 0.0, WRJ0=_DOWN)
    hands.hold("right", yaw=0.15)
    hands.hold("left", yaw=-0.15)
    x, y = float(block[0]) + 0.075, float(block[1])
    low, high = 0.642, 0.775
    yield from hands.lead((x, y + 0.11, high), (x, y - 0.11, high), 30)
    yield from hands.lead((x, y + 0.11, low), (x, y - 0.11, low), 30, speed=0.4)
    yield from hands.lead((x, y + 0.08, low), (x, y - 0.08, low), 20, speed=0.2)
    for _ in range(30):
        yield from _clamp(hands, x, y, low)
    for i in range(40):
        yield from _clamp(hands, x, y, low + (high - low) * (i + 1) / 40)
    way = (bucket - hands.where("block/position"))[:2] / 80
    for i in range(90):
        x, y = (x + float(way[0]), y + float(way[1])) if i < 80 else (x, y)
        yield from _clamp(hands, x, y, high)
    yield from hands.lead((x, y + 0.11, high), (x, y - 0.11, high), hands.episode_steps, speed=0.2)


def _clamp(hands: HandController, x: float, y: float, height: float) -> Actions:
    """Presses the hands together, whatever lies between them, and moves their middle in y."""
    right, left = float(hands.at("right")[1]), float(hands.at("left")[1])
    way = y - 0.5 * (right + left)
    yield from hands.lead((x, right + way - _PRESS, height), (x, left + way + _PRESS, height))


# Of a fork: from its block to the hand's point where it pushes, and where it lets go of it; height above the floor;
# angles that spread forefinger and little finger. Metres, rad.
_BEHIND, _CLEAR, _LOW = 0.06, 0.09, 0.642
_FORK = {"FFJ3": 0.3, "LFJ3": -0.3, "MFJ2": 1.4, "MFJ1": 1.4, "RFJ2": 1.4, "RFJ1": 1.4}


def push_blocks(hands: HandController) -> Actions:
    """Each hand takes its block between forefinger and little finger and pushes it to its goal."""
    blocks, goals = {"right": "block2", "left": "block1"}, {"right": "goal2", "left": "goal1"}
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
            lead = way * (0.05 / far if far > 0.05 else 0.0 if far < 0.01 else 1.0)
            # Where the fork is, if it follows its block; it never runs ahead.
            ahead = float(lead[0])
            points.append(beside(place, _BEHIND + ahead if ahead < -0.004 else _CLEAR, float(lead[1]), _LOW))
        yield from hands.lead_each(points, 0.5)


def stack_block(hands: HandController) -> Actions:
    """The right hand pushes block 2 to its place; both hands lift block 1 between their fingertips and set it down."""
    # Both blocks beside each other at the target pay almost as much as the stack.
    block1, block2 = hands.where("block1/position"), hands.where("block2/position")
    for side in SIDES:
        hands.bend(side, 0.5, 0.2)
    behind1, behind2 = -0.03 - _FINGERS, 0.05 + _FINGERS
    yield from hands.lead(beside(block2, 0.0, behind2, 0.70), beside(block1, 0.0, behind1 - 0.03, 0.70), 10, speed=0.66)
    yield from hands.lead(beside(block2, 0.0, behind2, 0.655), beside(block1, 0.0, behind1 - 0.03, 0.655), 12)
    y, goal = float(hands.at("right")[1]), float(hands.frozen("goal2")[1])
    while float(hands.where("block2/position")[1]) > goal + 0.004 and hands.taken < 80:
        y -= 0.0028
        yield from hands.lead(
            (float(block2[0]) + 0.008, y, 0.655), beside(block1, 0.0, -0.05 - _FINGERS, 0.655), speed=0.4
        )
    hands.bend("right", 1.35, 0.15)  # a hook, to reach between the blocks from above
    back = float(hands.at("right")[1]) + 0.01
    yield from hands.lead((float(block1[0]), back, 0.76), beside(block1, 0.0, behind1 - 0.02, 0.655), 10)
    yield from hands.lead(beside(block1, 0.0, 0.065, 0.76), beside(block1, 0.0, behind1 - 0.01, 0.655), 14)
    yield from hands.lead(beside(block1, 0.0, 0.065, 0.715), beside(block1, 0.0, behind1 - 0.005, 0.655), 10, speed=0.4)
    hooked = float(block1[0]), float(hands.at("right")[1]), 0.684
    yield from hands.lead(hooked, beside(block1, 0.0, behind1, 0.655), 12, speed=0.4)
    yield from _carry_block1(hands, float(block1[0]))


def _carry_block1(hands: HandController, x: float) -> Actions:
    """Closes both hands on block 1, lifts it, carries it over block 2, sets it down and lets go."""
    right, left = float(hands.at("right")[1]), float(hands.at("left")[1])
    high, low = 0.684, 0.655
    for _ in range(14):
        right, left = right - 0.0025, left + 0.001
        yield from hands.lead((x, right, high), (x, left, low), speed=0.3)
    right, left = float(hands.at("right")[1]) - 0.004, float(hands.at("left")[1]) + 0.004  # about 16 N
    yield from hands.lead((x, right, high), (x, left, low), 6)
    for _ in range(18):
        high, low = high + 0.068 / 18, low + 0.068 / 18
        yield from hands.lead((x, right, high), (x, left, low))
    way = (hands.where("block2/position") - hands.where("block1/position"))[:2] / 32
    for _ in range(32):
        x, right, left = x + float(way[0]), right + float(way[1]), left + float(way[1])
        yield from hands.lead((x, right, high), (x, left, low))
    top = float(hands.where("block2/position")[2]) + 0.0505
    for _ in range(30):
        if float(hands.where("block1/position")[2]) < top:
            break
        high, low = high - 0.0012, low - 0.0012
        yield from hands.lead((x, right, high), (x, left, low))
    for _ in range(14):
        right, left = right + 0.0012, left - 0.0012
        yield from hands.lead((x, right, high), (x, left, low))
    yield from hands.lead((x, right, high), (x, left, low), hands.episode_steps)

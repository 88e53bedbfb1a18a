"""Scripts for the classes that are solved by a sequence the planner does not find on the printed reward.

GraspAndPlace: the reward for the block's nearness is flat where the block starts, and a push pays only after the hand
has followed. StackBlock: both blocks beside each other at the target pay almost as much as the stack.
"""

from collections.abc import Callable

from torch import Tensor

from bidex_meta.errors import BidexError
from bidex_meta.witness.puppets import Point, Puppets

_FINGERS = 0.085
"""From a hand's point to the tips of its bent fingers, metres."""


def script_of(name: str) -> Callable[[Puppets], None]:
    """The script of a class.

    Raises:
        BidexError: It has none.
    """
    scripts = {"GraspAndPlace": grasp_and_place, "StackBlock": stack_block}
    if name not in scripts:
        raise BidexError(f"Expected a class with a script ({', '.join(scripts)}), got {name}; leave --script out.")
    return scripts[name]


def grasp_and_place(hands: Puppets) -> None:
    """The right hand tips the bucket towards the block and holds it, the left hand pushes the block in."""
    bucket, block = hands.where("bucket/position"), hands.where("block/position")
    away = _from(block, 0.0, -0.14, 0.635)
    hands.lead(_from(bucket, -0.02, 0.13, 0.75), _from(block, 0.0, -0.14, 0.75), 30, speed=1.0)
    hands.lead(_from(bucket, -0.02, 0.12, 0.685), away, 20)
    for i in range(6):
        hands.lead(_from(bucket, -0.02, 0.11 - 0.025 * i, 0.69), away, 5)
    hands.lead(_from(bucket, -0.02, 0.10, 0.72), _from(block, 0.0, -0.13, 0.635), 15)

    bucket = hands.where("bucket/position")  # it lies now, its mouth towards the block
    behind = _from(bucket, 0.0, 0.09, 0.650)
    hands.lead(_from(bucket, 0.0, 0.14, 0.72), _from(block, 0.0, -0.11, 0.635), 12)
    near = _from(block, 0.0, -0.10, 0.632)
    hands.lead(_from(bucket, 0.0, 0.14, 0.655), near, 12)
    hands.lead(_from(bucket, 0.0, 0.105, 0.655), near, 12, speed=0.2)

    x, y = (float(value) for value in hands.at("left")[:2])
    while not hands.over():
        block, mouth = hands.where("block/position"), hands.where("bucket/mouth_position")
        x += max(-0.0015, min(0.0015, 0.1 * float(mouth[0] - block[0])))
        y += 0.0018 if _depth_left(hands) > 0.015 else 0.0  # slowly: a block that slides is nowhere twice
        hands.lead(behind, (x, y, 0.634), speed=0.3)


def _depth_left(hands: Puppets) -> float:
    """How far the block still is from the bucket's origin along its axis, metres, in the copy where it is farthest."""
    sensors = ("bucket/position", "block/position", "bucket/mouth_position")
    bucket, block, mouth = (hands.everywhere(sensor) for sensor in sensors)
    axis = (mouth - bucket) / (mouth - bucket).norm(dim=1, keepdim=True)
    return float(((block - bucket) * axis).sum(dim=1).max())


def stack_block(hands: Puppets) -> None:
    """The right hand pushes block 2 to its place; both hands lift block 1 between their fingertips and set it down."""
    block1, block2 = hands.where("block1/position"), hands.where("block2/position")
    for side in ("right", "left"):
        hands.bend(side, 0.5, 0.2)
    behind1, behind2 = -0.03 - _FINGERS, 0.05 + _FINGERS
    hands.lead(_from(block2, 0.0, behind2, 0.70), _from(block1, 0.0, behind1 - 0.03, 0.70), 10, speed=0.66)
    hands.lead(_from(block2, 0.0, behind2, 0.655), _from(block1, 0.0, behind1 - 0.03, 0.655), 12)
    _push_block2(hands, block1, block2)

    hands.bend("right", 1.35, 0.15)  # a hook, to reach between the blocks from above
    back = float(hands.at("right")[1]) + 0.01
    hands.lead((float(block1[0]), back, 0.76), _from(block1, 0.0, behind1 - 0.02, 0.655), 10)
    hands.lead(_from(block1, 0.0, 0.065, 0.76), _from(block1, 0.0, behind1 - 0.01, 0.655), 14)
    hands.lead(_from(block1, 0.0, 0.065, 0.715), _from(block1, 0.0, behind1 - 0.005, 0.655), 10, speed=0.4)
    hands.lead(
        (float(block1[0]), float(hands.at("right")[1]), 0.684), _from(block1, 0.0, behind1, 0.655), 12, speed=0.4
    )
    _carry_block1(hands, float(block1[0]))


def _push_block2(hands: Puppets, block1: Tensor, block2: Tensor) -> None:
    """Pushes block 2 to its target."""
    y, goal = float(hands.at("right")[1]), float(hands.frozen("target2")[1])
    while float(hands.where("block2/position")[1]) > goal + 0.004 and len(hands.actions) < 80:
        y -= 0.0028
        hands.lead((float(block2[0]) + 0.008, y, 0.655), _from(block1, 0.0, -0.05 - _FINGERS, 0.655), speed=0.4)


def _carry_block1(hands: Puppets, x: float) -> None:
    """Closes both hands on block 1, lifts it, carries it over block 2, sets it down and lets go."""
    right, left = float(hands.at("right")[1]), float(hands.at("left")[1])
    high, low = 0.684, 0.655
    for _ in range(14):
        right, left = right - 0.0025, left + 0.001
        hands.lead((x, right, high), (x, left, low), speed=0.3)
    right, left = float(hands.at("right")[1]) - 0.004, float(hands.at("left")[1]) + 0.004  # about 16 N
    hands.lead((x, right, high), (x, left, low), 6)
    for _ in range(18):
        high, low = high + 0.068 / 18, low + 0.068 / 18
        hands.lead((x, right, high), (x, left, low))
    way = (hands.where("block2/position") - hands.where("block1/position"))[:2] / 32
    for _ in range(32):
        x, right, left = x + float(way[0]), right + float(way[1]), left + float(way[1])
        hands.lead((x, right, high), (x, left, low))
    top = float(hands.where("block2/position")[2]) + 0.0505
    for _ in range(30):
        if float(hands.where("block1/position")[2]) < top:
            break
        high, low = high - 0.0012, low - 0.0012
        hands.lead((x, right, high), (x, left, low))
    for _ in range(14):
        right, left = right + 0.0012, left - 0.0012
        hands.lead((x, right, high), (x, left, low))
    hands.lead((x, right, high), (x, left, low), hands.episode_steps)


def _from(point: Tensor, x: float, y: float, height: float) -> Point:
    """A place beside a point, at a height above the floor, metres."""
    return float(point[0]) + x, float(point[1]) + y, height

"""Scripted policy of version 2 for the bucket on a table: it is carried to its goal, then the block is dropped in."""

from torch import Tensor

from bidex_meta.witness.controller import Actions, HandController
from bidex_meta.witness.scripts.between import around, clamp, middle, move

_HIGH = 0.775  # height of the hands' points over everything, metres


def place_in_bucket(hands: HandController) -> Actions:
    """Both hands clamp the bucket and carry it to its goal, then the block, and drop it in."""
    hands.bend("right", 0.0, 0.0, THJ3=0.5, THJ1=-0.5, THJ0=-1.5, WRJ0=0.2)  # its thumb out of the way
    hands.bend("left", 0.0, 0.0, WRJ0=0.2)
    hands.hold("right", yaw=0.15)
    hands.hold("left", yaw=-0.15)
    while hands.steps_left:
        bucket, block = hands.where("bucket/position"), hands.where("block/position")
        if float((hands.frozen("goal")[:2] - bucket[:2]).norm()) > 0.035:
            yield from _carry_bucket(hands)
        elif float((block - bucket)[:2].norm()) > 0.03:
            yield from _carry_block(hands)
        else:
            yield from hands.lead_each((float(bucket[0]) + 0.06, float(bucket[1]) + y, _HIGH) for y in (0.15, -0.15))


def _carry_bucket(hands: HandController) -> Actions:
    low, carried = 0.67, 0.69
    bucket = hands.where("bucket/position")
    yield from around(hands, bucket, 0.05, 0.13, _HIGH, 40, 1.2)
    yield from around(hands, bucket, 0.05, 0.13, low, 30)
    yield from _grip(hands, bucket, 0.05, low)
    yield from clamp(hands, bucket, carried, 12, ahead=0.05)
    yield from move(hands, "bucket/position", hands.frozen("goal"), carried, 0.03)
    yield from clamp(hands, middle(hands), low, 12)
    yield from around(hands, middle(hands), 0.0, 0.14, low, 15)
    yield from around(hands, middle(hands), 0.0, 0.14, _HIGH, 12)


def _carry_block(hands: HandController) -> Actions:
    low = 0.630
    block = hands.where("block/position")
    yield from around(hands, block, 0.075, 0.11, _HIGH, 40, 1.2)
    yield from around(hands, block, 0.075, 0.11, low, 30)
    yield from _grip(hands, block, 0.075, low)
    yield from clamp(hands, block, _HIGH, 20, ahead=0.075)
    yield from move(hands, "block/position", hands.where("bucket/position"), _HIGH, 0.05)
    yield from around(hands, middle(hands), 0.0, 0.12, _HIGH, 15, speed=0.3)


def _grip(hands: HandController, place: Tensor, ahead: float, height: float) -> Actions:
    """Closes the hands until what is between them bends their fingers aside."""
    for _ in range(60):
        if abs(float(hands.where("right/FFJ3_position"))) + abs(float(hands.where("left/LFJ3_position"))) > 0.1:
            break
        yield from clamp(hands, place, height, ahead=ahead, press=0.012)
    yield from clamp(hands, place, height, 5, ahead=ahead)

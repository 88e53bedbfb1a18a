"""Scripted policy of version 2 for the bucket on a table: it is carried to its goal, then the block is dropped in."""

from torch import Tensor

from bidex_meta.witness.controller import Actions, HandController, beside
from bidex_meta.witness.scripts.between import around, clamp, middle, move

_HIGH = 0.775  # height of the hands' points over everything, metres


def place_in_bucket(hands: HandController) -> Actions:
    """Both hands clamp the bucket and carry it to its goal, then the block, and drop it in; what fails is repeated."""
    # A bucket that is dragged tips: friction acts 5 cm below its middle, and its foot is 3 cm wide.
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
            yield from hands.lead_each(beside(bucket, 0.06, y, _HIGH) for y in (0.15, -0.15))


def _carry_bucket(hands: HandController) -> Actions:
    bucket, ahead, low, carried = hands.where("bucket/position"), 0.05, 0.67, 0.69
    yield from around(hands, bucket, ahead, 0.13, _HIGH, 40, speed=1.2)
    yield from around(hands, bucket, ahead, 0.13, low, 30)
    yield from _grip(hands, bucket, ahead, low)
    yield from clamp(hands, bucket, carried, 12, ahead)
    yield from move(hands, "bucket/position", hands.frozen("goal"), carried, 0.03)
    yield from clamp(hands, middle(hands), low, 12)
    yield from around(hands, middle(hands), 0.0, 0.14, low, 15)
    yield from around(hands, middle(hands), 0.0, 0.14, _HIGH, 12)


def _carry_block(hands: HandController) -> Actions:
    block, ahead, low = hands.where("block/position"), 0.075, 0.63
    yield from around(hands, block, ahead, 0.11, _HIGH, 40, speed=1.2)
    yield from around(hands, block, ahead, 0.11, low, 30)
    yield from _grip(hands, block, ahead, low)
    yield from clamp(hands, block, _HIGH, 20, ahead)
    yield from move(hands, "block/position", hands.where("bucket/position"), _HIGH, 0.05)
    yield from around(hands, middle(hands), 0.0, 0.12, _HIGH, 15, speed=0.3)


def _grip(hands: HandController, place: Tensor, ahead: float, height: float) -> Actions:
    """Closes the hands until what is between them bends their fingers aside."""
    for _ in range(60):
        if abs(float(hands.where("right/FFJ3_position"))) + abs(float(hands.where("left/LFJ3_position"))) > 0.1:
            break
        yield from clamp(hands, place, height, ahead=ahead, press=0.012)
    yield from clamp(hands, place, height, 5, ahead=ahead)

"""Scripted policy of version 2 for the bucket on a table: it is carried to its goal, then the block is dropped in."""

import torch
from torch import Tensor

from bidex_meta.hands.hand import SIDES
from bidex_meta.witness.controller import Actions, HandController

_PRESS = 0.002  # distance inside what a hand presses to which it is led, metres: about 8 N
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
    yield from _around(hands, bucket, 0.05, 0.13, _HIGH, 40, 1.2)
    yield from _around(hands, bucket, 0.05, 0.13, low, 30)
    yield from _grip(hands, bucket, 0.05, low)
    yield from _clamp(hands, bucket, carried, 12, ahead=0.05)
    yield from _move(hands, "bucket/position", hands.frozen("goal"), carried, 0.03)
    yield from _clamp(hands, _middle(hands), low, 12)
    yield from _around(hands, _middle(hands), 0.0, 0.14, low, 15)
    yield from _around(hands, _middle(hands), 0.0, 0.14, _HIGH, 12)


def _carry_block(hands: HandController) -> Actions:
    low = 0.630
    block = hands.where("block/position")
    yield from _around(hands, block, 0.075, 0.11, _HIGH, 40, 1.2)
    yield from _around(hands, block, 0.075, 0.11, low, 30)
    yield from _grip(hands, block, 0.075, low)
    yield from _clamp(hands, block, _HIGH, 20, ahead=0.075)
    yield from _move(hands, "block/position", hands.where("bucket/position"), _HIGH, 0.05)
    yield from _around(hands, _middle(hands), 0.0, 0.12, _HIGH, 15, speed=0.3)


def _grip(hands: HandController, place: Tensor, ahead: float, height: float) -> Actions:
    """Closes the hands until what is between them bends their fingers aside."""
    for _ in range(60):
        if abs(float(hands.where("right/FFJ3_position"))) + abs(float(hands.where("left/LFJ3_position"))) > 0.1:
            break
        yield from _clamp(hands, place, height, ahead=ahead, press=0.012)
    yield from _clamp(hands, place, height, 5, ahead=ahead)


def _move(hands: HandController, what: str, goal: Tensor, height: float, reach: float) -> Actions:
    """Carries what is clamped over a goal."""
    for _ in range(100):
        place = hands.where(what)
        way = goal[:2] - place[:2]
        if float(way.norm()) < 0.006 or float(hands.at("right")[2] - place[2]) > 0.06:
            break
        way *= min(1.0, reach / float(way.norm()))
        yield from _clamp(hands, _middle(hands) + way, height)


def _around(hands: HandController, place: Tensor, ahead: float, half: float, height: float, steps: int, speed: float = 0.6) -> Actions:
    """Leads the hands to both sides of a place."""
    x, y = float(place[0]) + ahead, float(place[1])
    right, left = (x, y + half, height), (x, y - half, height)
    for _ in range(steps):
        off = [(hands.at(side) - torch.tensor(goal)).norm() for side, goal in zip(SIDES, (right, left))]
        if max(off) < 0.01:
            break
        yield from hands.lead(right, left, 1, speed)


def _middle(hands: HandController) -> Tensor:
    """Horizontal place between the hands, (2,)."""
    return 0.5 * (hands.at("right") + hands.at("left"))[:2]


def _clamp(hands: HandController, place: Tensor, height: float, steps: int = 1, ahead: float = 0.0, press: float = _PRESS) -> Actions:
    """Presses the hands together, whatever lies between them, and moves their middle."""
    x, y = float(place[0]) + ahead, float(place[1])
    for _ in range(steps):
        right, left = float(hands.at("right")[1]), float(hands.at("left")[1])
        way = y - 0.5 * (right + left)
        now = 0.5 * float(hands.at("right")[2] + hands.at("left")[2])
        z = max(now - 0.04, min(now + 0.04, height))  # a fast hand would press less
        yield from hands.lead((x, right + way - press, z), (x, left + way + press, z))

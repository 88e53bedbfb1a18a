"""What policies share that carry a thing between both hands, one on either side of it along y."""

import torch
from torch import Tensor

from bidex_meta.hands.hand import SIDES
from bidex_meta.witness.controller import Actions, HandController, Point

PRESS = 0.002  # distance inside what a hand presses to which it is led, metres: about 8 N


def move(hands: HandController, what: str, goal: Tensor, height: float, far: float, press: float = PRESS) -> Actions:
    """Carries what is clamped to a goal, at most ``far`` metres ahead of it; ends too where it is lost."""
    for _ in range(100):
        place = hands.where(what)
        way = goal[:2] - place[:2]
        if float(way.norm()) < 0.01 or float(hands.at("right")[2] - place[2]) > 0.09:
            break
        way *= min(1.0, far / float(way.norm()))
        yield from clamp(hands, middle(hands) + way, height, press=press)


def around(
    hands: HandController, place: Tensor, ahead: float, half: float, height: float, steps: int, speed: float = 0.6
) -> Actions:
    """Leads the hands to both sides of a place: ``half`` metres beside it in y, ``ahead`` of it in x."""
    x, y = float(place[0]) + ahead, float(place[1])
    yield from reach(hands, (x, y + half, height), (x, y - half, height), steps, speed)


def reach(hands: HandController, right: Point, left: Point, steps: int, speed: float = 0.6) -> Actions:
    """Leads the hands to two points until both are there."""
    goals = torch.tensor([right, left])
    for _ in range(steps):
        off = torch.stack([hands.at(side) for side in SIDES]) - goals
        if float(off.norm(dim=1).max()) < 0.01:
            break
        yield from hands.lead(right, left, 1, speed)


def middle(hands: HandController) -> Tensor:
    """Horizontal place between the hands, (2,)."""
    return 0.5 * (hands.at("right") + hands.at("left"))[:2]


def clamp(
    hands: HandController, place: Tensor, height: float, steps: int = 1, ahead: float = 0.0, press: float = PRESS
) -> Actions:
    """Presses the hands together, whatever lies between them, and moves their middle to a place."""
    x, y = float(place[0]) + ahead, float(place[1])
    for _ in range(steps):
        right, left = float(hands.at("right")[1]), float(hands.at("left")[1])
        way = y - 0.5 * (right + left)
        now = 0.5 * float(hands.at("right")[2] + hands.at("left")[2])
        z = max(now - 0.04, min(now + 0.04, height))  # lead slows a faster hand down, press and all
        yield from hands.lead((x, right + way - press, z), (x, left + way + press, z))

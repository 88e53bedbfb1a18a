"""Scripted policy for the bottle: a finger drags the cap to where it shall stand out."""

import torch
from torch import Tensor

from bidex_meta.utils.maths import rotate
from bidex_meta.witness.controller import HandController, Point, point

_TIP = 0.035  # from a finger's last joint to what its tip touches on a cap's axis, metres
_HELD = {"THJ4": -1.04, "THJ3": 1.2, "THJ0": -1.57}  # the right thumb stays behind the bottle, rad
_FIST = {f"{finger}J{joint}": 1.4 for finger in ("FF", "MF", "RF") for joint in (1, 2)}


def pull_cap(hands: HandController) -> None:
    """The left little finger presses on the cap's side and drags it along the bottle; friction keeps it there."""
    slide = float(hands.frozen("slide")) if hands.wide else 0.04
    stay = point(hands.at("right"))
    for side in ("right", "left"):
        hands.hold(side)
    ahead = _ahead(hands)

    def poke(back: float, aside: float = 0.0) -> Point:
        """The left hand's point with the little finger so far before the cap, metres."""
        cap = hands.where("bottle/cap_position") - (_TIP + back) * ahead
        cap[0] += aside
        return point(hands.at("left") + cap - hands.where("left/lfdistal_position"))

    hands.bend("right", 0.5, 0.6, **_HELD)
    hands.bend("left", 0.0, 0.0, **_FIST)
    first = hands.at("left") - 0.07 * ahead
    hands.lead(stay, point(first), 12, speed=0.4)
    hands.bend("right", 0.9, 1.0, **_HELD)
    for _ in range(32):
        hands.lead(stay, poke(0.04), speed=0.4)
    for _ in range(12):
        hands.lead(stay, poke(-0.002), speed=0.2)
    still = 0
    while hands.steps_left:
        left = slide - float(hands.where("bottle/slide"))
        still = still + 1 if abs(left) < 0.0015 or still > 3 else 0
        if still > 3:
            hands.lead(stay, point(hands.at("left") - 0.01 * ahead), speed=0.2)
            continue
        way = max(-0.012, min(0.012, 0.45 * left)) * _axis(hands) + 0.0012 * ahead
        hands.lead(stay, point(hands.at("left") + way), speed=0.3)


def _axis(hands: HandController) -> Tensor:
    """Where the cap slides to, world."""
    return rotate(hands.orientation("bottle/quaternion"), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))


def _ahead(hands: HandController) -> Tensor:
    """Where the left hand's straight fingers point, world."""
    way = hands.where("left/palm_position") - hands.where("left/mount_position")
    return way / way.norm()

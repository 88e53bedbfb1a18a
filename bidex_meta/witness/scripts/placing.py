"""Scripted policy of version 2 for the bucket on a table: it is carried to its goal, then the block is dropped in."""

from bidex_meta.witness.controller import Actions, HandController
from bidex_meta.witness.scripts.between import Between, Take

_SPREAD = ("FFJ3", "LFJ3"), (0.12, -0.12), (0.0, 0.0)
# A bucket that is dragged tips: friction acts 5 cm below its middle, and its foot is 3 cm wide.
_BUCKET = Take(0.065, 0.013, 0.775, 0.145, *_SPREAD)
_BLOCK = Take(0.075, 0.005, 0.775, 0.115, *_SPREAD)
_STANDS = 0.657


def place_in_bucket(hands: HandController) -> Actions:
    """Both hands clamp the bucket and carry it to its goal, then the block, and drop it in; what fails is repeated."""
    hands.bend("right", 0.0, 0.0, THJ3=0.5, THJ1=-0.5, THJ0=-1.5, WRJ0=0.2, WRJ1=0.06, FFJ3=0.12)  # its thumb out of the way
    hands.bend("left", 0.0, 0.0, WRJ0=0.2, WRJ1=-0.06, LFJ3=-0.12)
    hands.hold("right", yaw=0.12)
    hands.hold("left", yaw=-0.12)
    goal = hands.frozen("goal") if hands.wide else None
    while hands.steps_left:
        place, gap = hands.where("bucket/position"), float((hands.where("bucket/position") - hands.where("block/position"))[1])
        bucket, block = Between(hands, "bucket", _BUCKET), Between(hands, "block", _BLOCK, (max(0.1, gap - 0.12), 1.0))
        misplaced = goal is not None and bucket.far(goal) > 0.033 - 0.021 * bucket.held
        if misplaced or bucket.held > 0.5 and bucket.thing[2] > _STANDS + 0.012:
            points = bucket.carry(place if goal is None else goal, _STANDS + 0.02, _STANDS)
        elif bucket.off < 0.05 and bucket.over < 0.08:
            points = bucket.leave()
        elif block.far(place) > 0.03 - 0.015 * block.held:
            points = block.carry(place, 0.765, 0.765)
        else:
            points = block.leave()
        yield from hands.lead_each(points)

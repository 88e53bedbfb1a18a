"""Scripted policy that puts a block into a bucket; in version 2 the bucket is first carried to its goal."""

from bidex_meta.witness.controller import Actions, HandController
from bidex_meta.witness.scripts.between import Between, Take, blend, ramp

# The right forefinger and the left little finger spread towards each other and press until they are straight.
_SPREAD = 0.12
_WRIST = 0.06
_YAW = 0.12
_PRESSED = ("FFJ3", "LFJ3"), (_SPREAD, -_SPREAD), (0.0, 0.0)
_BUCKET = Take(0.065, 0.013, 0.775, 0.145, 0.02, *_PRESSED)
_BLOCK = Take(0.065, 0.005, 0.775, 0.115, 0.035, *_PRESSED, press=1.3)
# These are heights in metres: of a bucket on the table, and of the block above it.
_STANDS = 0.657
_OVER = 0.765


def place_in_bucket(hands: HandController) -> Actions:
    """Clamp the bucket with both hands and carry it to its goal, then drop the block in; repeat a step that fails."""
    # A bucket that is dragged tips: friction acts 5 cm below its middle, and its foot is 3 cm wide.
    thumb_away = {"THJ3": 0.5, "THJ1": -0.5, "THJ0": -1.5}
    hands.bend("right", 0.0, 0.0, WRJ0=0.2, WRJ1=_WRIST, FFJ3=_SPREAD, **thumb_away)
    hands.bend("left", 0.0, 0.0, WRJ0=0.2, WRJ1=-_WRIST, LFJ3=-_SPREAD)
    hands.hold("right", yaw=_YAW)
    hands.hold("left", yaw=-_YAW)
    while hands.steps_left:
        place = hands.where("bucket/position")
        goal = hands.frozen("goal") if hands.wide else place
        gap = float((place - hands.where("block/position"))[1])
        # The right hand must not descend onto the bucket.
        bucket = Between(hands, "bucket", _BUCKET)
        block = Between(hands, "block", _BLOCK, (max(0.1, gap - 0.12), 1.0))
        # Most steps pass into the next one gradually, so that a network can learn them.
        if bucket.far(goal) > 0.033 - 0.021 * bucket.held:
            bring = 1.0
        else:
            bring = ramp(bucket.thing[2] - _STANDS, 0.006, 0.018) * ramp(bucket.off, 0.07, 0.05)
        around = ramp(bucket.off, 0.06, 0.04) * ramp(bucket.over, 0.1, 0.06)
        off_bucket = ramp(block.far(place), 0.02 - 0.01 * block.held, 0.035 - 0.015 * block.held)
        drop = blend(off_bucket, block.carry(place, _OVER, _OVER), block.leave())
        put = blend(around, bucket.leave(), drop)
        points = blend(bring, bucket.carry(goal, _STANDS + 0.02, _STANDS), put)
        yield from hands.lead_each(points)

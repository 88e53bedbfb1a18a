"""The bucket of GraspAndPlace and PourWater: what lies inside it, and whether it stands."""

import math

from torch import Tensor

from bidex_meta.utils.maths import conjugate, rotate, uprightness

FLOOR, RIM = -0.049, 0.0445
"""Heights of the inner floor and of the rim in the bucket's frame, metres (assets/objects/bucket.xml)."""
MOUTH = 0.0345
"""Height of its point on the axis just below the rim, metres: the site ``mouth``."""
_UPRIGHT = math.radians(45.0)
"""A bucket that is tipped by more keeps nothing."""
_FLOOR_RADIUS, _RIM_RADIUS = 0.0255, 0.053
"""Inner radius at these heights, to the middle of a wall, metres."""


def inside_bucket(points: Tensor, bucket: Tensor, quaternion: Tensor) -> Tensor:
    """Which points (n, k, 3) are in a bucket: between floor and rim, and within the wall's radius there. (n, k), bool.

    Points and buckets' origins (n, 3) in the world, metres; the buckets' orientations (x, y, z, w), (n, 4).
    """
    x, y, z = rotate(conjugate(quaternion)[:, None], points - bucket[:, None]).unbind(-1)
    share = (z - FLOOR) / (RIM - FLOOR)
    radius = _FLOOR_RADIUS + (_RIM_RADIUS - _FLOOR_RADIUS) * share
    return (share > 0.0) & (share < 1.0) & ((x * x + y * y).sqrt() < radius)


def stands(quaternion: Tensor) -> Tensor:
    """Whether buckets are within 45 degrees of upright, from orientations (x, y, z, w). Shape (n, 4) to (n,), bool."""
    return uprightness(quaternion) > math.cos(_UPRIGHT)

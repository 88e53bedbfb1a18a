"""The bucket that GraspAndPlace and PourWater fill: what lies inside it."""

from torch import Tensor

from bidex_meta.maths import conjugate, rotate

FLOOR, RIM = -0.049, 0.0445
"""Heights of the inner floor and of the rim in the bucket's frame, metres (assets/objects/bucket.xml)."""
_FLOOR_RADIUS, _RIM_RADIUS = 0.0255, 0.053
"""Inner radius at these heights, to the middle of a wall, metres."""


def inside_bucket(points: Tensor, bucket: Tensor, quaternion: Tensor) -> Tensor:
    """Which points are in a bucket: between floor and rim, and within the wall's radius there.

    Args:
        points: World positions, metres, shape (n, k, 3).
        bucket: World positions of the buckets' origins, shape (n, 3).
        quaternion: Their orientations (x, y, z, w), shape (n, 4).

    Returns:
        Shape (n, k), bool.
    """
    x, y, z = rotate(conjugate(quaternion)[:, None], points - bucket[:, None]).unbind(-1)
    share = (z - FLOOR) / (RIM - FLOOR)
    radius = _FLOOR_RADIUS + (_RIM_RADIUS - _FLOOR_RADIUS) * share
    return (share > 0.0) & (share < 1.0) & ((x * x + y * y).sqrt() < radius)

"""Start poses of hands: the mount's position and orientation in the world (docs/figures.md, start poses)."""

import math
from dataclasses import dataclass

from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.maths import quaternion_from_rpy, quaternion_product
from bidex_meta.utils.validation import Finite

MOUNT_QUATERNION = (0.0, 0.0, -math.sqrt(0.5), math.sqrt(0.5))
"""Orientation (w, x, y, z) of the mount if the actor is not rotated: fingers to world -y, palm up, thumb to -x."""

PALM_UP_AWAY = (0.0, 0.0, 0.0)
"""Pose A of docs/figures.md, as roll, pitch and yaw: fingers to -y, palm up."""
PALM_UP_BACK = (0.0, 0.0, math.pi)
"""Pose B: fingers to +y, palm up; faces a hand in pose A."""

PALM_LEFT_AHEAD = (math.pi, 0.5 * math.pi, 0.5 * math.pi)
"""Pose C: fingers to -x, palm to -y, thumb up: a right hand facing a left hand. The original has 1.57 for pi / 2."""
PALM_RIGHT_AHEAD = (math.pi, -0.5 * math.pi, 0.5 * math.pi)
"""Pose D: fingers to -x, palm to +y, thumb down."""
PALM_DOWN_AHEAD = (math.pi, 0.0, 0.5 * math.pi)
"""Pose E: fingers to -x, palm down."""
PALM_DOWN_AWAY = (math.pi, 0.0, math.pi)
"""Pose F: fingers to -y, palm down."""
PALM_DOWN_BACK = (math.pi, 0.0, 0.0)
"""Pose G: fingers to +y, palm down; faces a hand in pose F."""


@checked_arguments
@dataclass(frozen=True)
class HandPose:
    """Start pose of one hand.

    ``position`` is the mount's origin in the world, in metres. ``rpy`` is the roll, pitch and yaw of the hand's actor
    as in Isaac Gym, in radians: R = Rz(yaw) Ry(pitch) Rx(roll), to which the mount's own rotation is then applied.
    """

    position: tuple[Finite, Finite, Finite]
    rpy: tuple[Finite, Finite, Finite]

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """Return the orientation (w, x, y, z) of the mount in the world."""
        return quaternion_product(quaternion_from_rpy(self.rpy), MOUNT_QUATERNION)

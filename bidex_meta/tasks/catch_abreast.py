"""CatchAbreast: appendix A.2.5; docs/figures.md, classes."""

import math
from typing import ClassVar

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.poses import HandPose
from bidex_meta.tasks.eggs import EggTask

_TILT = 0.3925


class CatchAbreast(EggTask):
    """Throw an egg sideways between two palms that lie side by side, tilted to each other.

    Observation: Table 16 (422). Reward: equation 5. The episode also fails when a palm is 0.1 m off its anchor.
    """

    needs = Capacity(23, 6, 45)
    name = "CatchAbreast"
    summary = "Throw an egg sideways from the right palm to the left one"
    episode_steps = 150
    right = HandPose((0.0, -0.55, 0.5), (0.0, _TILT, -0.5 * math.pi))
    left = HandPose((0.0, -1.15, 0.5), (0.0, -_TILT, -0.5 * math.pi))
    transition_scale, orientation_scale = 0.5, 1.0
    starts = ((-0.39, -0.55, 0.54),)
    goals = ((-0.39, -1.15, 0.54),)
    position_noise, joint_noise = 0.0, 0.0
    floor = 0.2
    anchors: ClassVar = {"right/palm_position": (-0.3, -0.55, 0.5), "left/palm_position": (-0.3, -1.15, 0.5)}
    camera_target, camera_distance = (-0.25, -0.85, 0.5), 1.4

"""CatchOver2Underarm: appendix A.2.3; docs/figures.md, classes."""

import math
from typing import ClassVar

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.poses import PALM_UP_BACK, HandPose
from bidex_meta.tasks.eggs import EggTask


class CatchOver2Underarm(EggTask):
    """Throw an egg from an upright hand down to an upturned palm.

    Observation: Table 12 (422). Reward: equation 3 with alpha 20. The episode also fails when a mount is 0.1 m off its
    start.
    """

    needs = Capacity(17, 4, 33)
    name = "CatchOver2Underarm"
    summary = "Throw an egg from the upright right hand to the upturned left palm"
    formula = "exp(-0.2 (20 d + r)), d and r the distance and the angle between egg and goal"
    deviations = ("The egg starts at z 1.03 instead of 1.00, where it would stick in the fingertips.",)
    episode_steps = 75
    right = HandPose((0.0, 0.0, 0.5), (1.67, math.pi, 0.0))
    left = HandPose((0.0, -0.8, 0.5), PALM_UP_BACK)
    transition_scale, orientation_scale = 0.1, 2.0
    starts = ((0.0, 0.05, 1.03),)
    goals = ((0.0, -0.40, 0.55),)
    position_noise, joint_noise = 0.0, 0.0
    lies_on_hand = False
    alpha = 20.0
    floor = 0.3
    anchors: ClassVar = {"right/mount_position": right.position, "left/mount_position": left.position}
    camera_target, camera_distance = (0.0, -0.3, 0.7), 1.6

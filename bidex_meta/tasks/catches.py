"""Task classes in which eggs are thrown or passed; the classes differ only in numbers.

Sources: A.2.1 to A.2.5 of the paper's appendix, and docs/figures.md, section Classes.
"""

import math
from typing import ClassVar

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.poses import PALM_UP_AWAY, PALM_UP_BACK, HandPose
from bidex_meta.tasks.eggs import EggTask, goal_object_blocks
from bidex_meta.tasks.solver import GENTLE


class CatchUnderarm(EggTask):
    """Throw an egg underarm from one upturned palm to the other, with moving bases.

    Observation: Table 10 of the paper's appendix, size (422). Reward: equation 2.
    """

    needs = Capacity(28, 6, 48)
    name = "CatchUnderarm"
    summary = "Throw an egg underarm from the right hand to the left one"
    episode_steps = 75
    wide_steps = 225  # hands move at 17 cm/s at most and an egg must be held at its goal, so 75 steps are too few
    right = HandPose((0.0, 0.0, 0.5), PALM_UP_AWAY)
    left = HandPose((0.0, -1.15, 0.5), PALM_UP_BACK)
    transition_scale = 0.05
    orientation_scale = 0.5
    starts = ((0.0, -0.39, 0.54),)
    goals = ((0.0, -0.79, 0.54),)
    position_noise = 0.01
    joint_noise = 0.2
    floor = 0.1


class HandOver(CatchUnderarm):
    """Pass an egg from one upturned palm to the other across a gap of 4 cm.

    Observation: Table 8 of the paper's appendix, size (398), with fixed bases. Suites use moving bases, with which the
    observation has 422 entries. Reward: equation 1. No source gives the scales of base forces and torques for this
    class, so it has the scales of CatchUnderarm (docs/figures.md, section Decisions).
    """

    needs = Capacity(28, 8, 51)
    name = "HandOver"
    summary = "Throw an egg from the right palm to the left one across a narrow gap"
    deviations = ("In a suite its bases move like CatchUnderarm's (52 actions); on its own they are fixed (40).",)
    moves_by_default = False
    left = HandPose((0.0, -1.0, 0.5), PALM_UP_BACK)
    goals = ((0.0, -0.64, 0.54),)
    floor = 0.2
    solver = GENTLE


class TwoCatchUnderarm(CatchUnderarm):
    """Throw two eggs at once, each to the other hand.

    Observation: Table 14 of the paper's appendix, size (446). Reward: equation 4. Both goals have the same orientation.
    Both eggs start with the same orientation and the same position noise (docs/figures.md, section Start noise).
    """

    needs = Capacity(42, 8, 57)
    name = "TwoCatchUnderarm"
    summary = "Throw two eggs at once, each to the other hand"
    formula = "exp(-0.2 (50 d1 + r1)) + exp(-0.2 (50 d2 + r2)), distance and angle of each egg and its goal"
    solved = "each egg within 3 cm of its goal in the same step"
    deviations = (
        "Success requires each egg to be near its goal; the original's limits the sum of both distances (6 cm).",
    )
    starts = ((0.0, -0.39, 0.54), (0.0, -0.78, 0.54))
    goals = ((0.0, -0.79, 0.54), (0.0, -0.38, 0.54))
    floor = 0.2
    numbers = ("1", "2")
    blocks = goal_object_blocks(numbers)


class CatchOver2Underarm(EggTask):
    """Throw an egg from an upright hand down to an upturned palm.

    Observation: Table 12 of the paper's appendix, size (422). Reward: equation 3 with alpha = 20. The episode fails
    when the egg drops, and also when the mount of a hand is 0.1 m or more from its start.
    """

    needs = Capacity(17, 4, 33)
    name = "CatchOver2Underarm"
    summary = "Throw an egg from the upright right hand to the upturned left palm"
    formula = "exp(-0.2 (20 d + r)), d and r the distance and the angle between egg and goal"
    deviations = ("The egg starts at z 1.03 instead of 1.00, where it would stick in the fingertips.",)
    episode_steps = 75
    wide_steps = 150
    right = HandPose((0.0, 0.0, 0.5), (1.67, math.pi, 0.0))
    left = HandPose((0.0, -0.8, 0.5), PALM_UP_BACK)
    transition_scale = 0.1
    orientation_scale = 2.0
    starts = ((0.0, 0.05, 1.03),)
    goals = ((0.0, -0.40, 0.55),)
    position_noise = 0.0
    joint_noise = 0.0
    lies_on_hand = False
    alpha = 20.0
    floor = 0.3
    anchors: ClassVar = {"right/mount_position": right.position, "left/mount_position": left.position}
    camera_target = (0.0, -0.3, 0.7)
    camera_distance = 1.6


class CatchAbreast(EggTask):
    """Throw an egg sideways between two palms that lie side by side, tilted towards each other.

    Observation: Table 16 of the paper's appendix, size (422). Reward: equation 5. The episode fails when the egg drops,
    and also when a palm is 0.1 m or more from a fixed point, its anchor.
    """

    needs = Capacity(23, 6, 45)
    name = "CatchAbreast"
    summary = "Throw an egg sideways from the right palm to the left one"
    episode_steps = 150
    right = HandPose((0.0, -0.55, 0.5), (0.0, 0.3925, -0.5 * math.pi))
    left = HandPose((0.0, -1.15, 0.5), (0.0, -0.3925, -0.5 * math.pi))
    transition_scale = 0.5
    orientation_scale = 1.0
    starts = ((-0.39, -0.55, 0.54),)
    goals = ((-0.39, -1.15, 0.54),)
    position_noise = 0.0
    joint_noise = 0.0
    floor = 0.2
    anchors: ClassVar = {"right/palm_position": (-0.3, -0.55, 0.5), "left/palm_position": (-0.3, -1.15, 0.5)}
    camera_target = (-0.25, -0.85, 0.5)
    camera_distance = 1.4

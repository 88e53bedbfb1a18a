"""TwoCatchUnderarm: appendix A.2.4; docs/figures.md, classes."""

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.poses import PALM_UP_AWAY, PALM_UP_BACK, HandPose
from bidex_meta.tasks.eggs import EggTask, goal_object_blocks


class TwoCatchUnderarm(EggTask):
    """Throw two eggs at once, each to the other hand.

    Observation: Table 14 (446). Reward: equation 4. Both goals share one orientation, both eggs one start noise and
    orientation (docs/figures.md, start noise).
    """

    needs = Capacity(42, 8, 57)
    name = "TwoCatchUnderarm"
    summary = "Throw two eggs at once, each to the other hand"
    formula = "exp(-0.2 (50 d1 + r1)) + exp(-0.2 (50 d2 + r2)), distance and angle of each egg and its goal"
    solved = "each egg within 3 cm of its goal in the same step"
    deviations = ("Success asks it of each egg, the original of the sum of both distances (6 cm).",)
    episode_steps = 75
    right = HandPose((0.0, 0.0, 0.5), PALM_UP_AWAY)
    left = HandPose((0.0, -1.15, 0.5), PALM_UP_BACK)
    transition_scale, orientation_scale = 0.05, 0.5
    starts = ((0.0, -0.39, 0.54), (0.0, -0.78, 0.54))
    goals = ((0.0, -0.79, 0.54), (0.0, -0.38, 0.54))
    position_noise, joint_noise = 0.01, 0.2
    floor = 0.2
    numbers = ("1", "2")
    blocks = goal_object_blocks(numbers)

"""CatchUnderarm: appendix A.2.2; docs/figures.md, classes."""

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.poses import PALM_UP_AWAY, PALM_UP_BACK, HandPose
from bidex_meta.tasks.eggs import EggTask


class CatchUnderarm(EggTask):
    """Throw an egg underarm from one upturned palm to the other, with moving bases.

    Observation: Table 10 (422). Reward: equation 2.
    """

    needs = Capacity(28, 6, 48)
    name = "CatchUnderarm"
    summary = "Throw an egg underarm from the right hand to the left one"
    episode_steps = 75
    right = HandPose((0.0, 0.0, 0.5), PALM_UP_AWAY)
    left = HandPose((0.0, -1.15, 0.5), PALM_UP_BACK)
    transition_scale, orientation_scale = 0.05, 0.5
    starts = ((0.0, -0.39, 0.54),)
    goals = ((0.0, -0.79, 0.54),)
    position_noise, joint_noise = 0.01, 0.2
    floor = 0.1

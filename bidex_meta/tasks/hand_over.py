"""HandOver: appendix A.2.1; docs/figures.md, classes."""

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.poses import PALM_UP_AWAY, PALM_UP_BACK, HandPose
from bidex_meta.tasks.base import GENTLE
from bidex_meta.tasks.eggs import EggTask


class HandOver(EggTask):
    """Pass an egg from one upturned palm to the other across a gap of 4 cm.

    Observation: Table 8 (398) with the fixed base, 422 with the moving one that the suites use. Reward: equation 1.
    """

    needs = Capacity(28, 8, 51)
    name = "HandOver"
    summary = "Throw an egg from the right palm to the left one across a narrow gap"
    deviations = ("In a suite its bases move like CatchUnderarm's (52 actions); on its own they are fixed (40).",)
    episode_steps = 75
    moves_by_default = False
    right = HandPose((0.0, 0.0, 0.5), PALM_UP_AWAY)
    left = HandPose((0.0, -1.0, 0.5), PALM_UP_BACK)
    # With a moving base the figures of CatchUnderarm hold (docs/figures.md, decisions); the original gives none.
    transition_scale, orientation_scale = 0.05, 0.5
    starts = ((0.0, -0.39, 0.54),)
    goals = ((0.0, -0.64, 0.54),)
    position_noise, joint_noise = 0.01, 0.2
    floor = 0.2
    solver = GENTLE

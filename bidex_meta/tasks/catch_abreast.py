"""CatchAbreast: appendix A.2.5; docs/figures.md, classes."""

import math

from torch import Tensor

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.poses import HandPose
from bidex_meta.tasks.eggs import EggTask, left_anchor
from bidex_meta.tasks.state import TaskState

_ANCHORS = ((-0.3, -0.55, 0.5), (-0.3, -1.15, 0.5))
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
    camera_target, camera_distance = (-0.25, -0.85, 0.5), 1.4

    def failed(self, state: TaskState) -> Tensor:
        """The egg dropped, or a palm has left its anchor."""
        return left_anchor(state, "palm_position", _ANCHORS, super().failed(state))

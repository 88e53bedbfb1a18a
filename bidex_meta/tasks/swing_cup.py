"""SwingCup: appendix A.2.11; docs/figures.md, classes."""

import math

import torch
from torch import Tensor

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.poses import PALM_LEFT_AHEAD, PALM_RIGHT_AHEAD, HandPose
from bidex_meta.tasks.base import FIRM
from bidex_meta.tasks.goals import frozen_goal, rotation_difference
from bidex_meta.tasks.layout import goal_blocks, handle_blocks, object_blocks
from bidex_meta.tasks.objects.pointed import OwnObjectClass
from bidex_meta.tasks.placement import DRAWS, placed, yaw_quaternion
from bidex_meta.tasks.scene import SceneObject, Table
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import component, join
from bidex_meta.utils.maths import multiply, norm, rotation_angle, xyzw

_CUP = SceneObject("cup", "cup", (0.0, 0.0, 0.6845), (0.0, 0.0, 0.5 * math.pi))
_SUCCESS_ANGLE = 0.25 * math.pi
_SUCCESS_DISTANCE = 0.2
"""The cup stays within this of where the task puts it, metres."""


class SwingCup(OwnObjectClass):
    """Turn a two-handled cup about the vertical, each hand at its ear.

    Observation: Table 28 (428). Reward: equation 13. The goal's turn is counted from the nominal start (yaw 90
    degrees), without the task's own start turn: it lies at least 72 degrees away, so no start is a success. The
    original's goal, half a turn away, is one end of the range. Goal position is the task's start position; the reward
    does not read it.
    """

    needs = Capacity(34, 4, 87)
    name = "SwingCup"
    summary = "Turn a two-handled cup with both hands"
    formula = "-1 - d_left - d_right + 5 / (r + 0.1), r the angle between the cup and its goal"
    solved = "cup within 45 degrees of its goal and within 20 cm of its start"
    deviations = (
        "Goals lie 90 to 180 degrees from the nominal start; the original's is half a turn away.",
        "Success asks that the cup stay near its start; reward and the original's success count its turn alone.",
    )
    episode_steps = 300
    right = HandPose((0.35, 0.2, 0.8), PALM_LEFT_AHEAD)
    left = HandPose((0.35, -0.2, 0.8), PALM_RIGHT_AHEAD)
    transition_scale, orientation_scale = 0.1, 0.1
    start_draws = DRAWS
    solver = FIRM
    table = Table((0.3, 0.3, 0.6), (0.0, 0.0, 0.3))
    objects = (_CUP,)
    points = ("cup/left_handle_position", "cup/right_handle_position")
    constant = -1.0
    ghost = (0.1, 0.012, 0.012)
    camera_target = (0.08, 0.0, 0.68)
    variation_space = join(placed("cup"), component("yaw_change", 0.5 * math.pi, math.pi))
    blocks = (
        *object_blocks("cup"),
        *goal_blocks("goal"),
        *handle_blocks("cup", "middle of the right hand's ear", "middle of the left hand's ear"),
    )

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """``cup``: place (n, 3); ``goal``: pose (n, 7); ``goal_inverse``: inverse of its rotation (n, 4)."""
        position = variation.new_tensor(_CUP.position).repeat(len(variation), 1)
        position[:, :2] += variation[:, :2]
        rotation = multiply(yaw_quaternion(variation[:, 3]), xyzw(variation.new_tensor(_CUP.quaternion)))
        return super().freeze(variation) | frozen_goal(torch.cat((position, rotation), dim=1))

    def target(self, state: TaskState) -> Tensor:
        return 5.0 / (_angle(state) + 0.1)

    def success(self, state: TaskState) -> Tensor:
        moved = norm(state["cup/position"] - state.frozen["goal"][:, :3])
        return (_angle(state) < _SUCCESS_ANGLE) & (moved < _SUCCESS_DISTANCE)


def _angle(state: TaskState) -> Tensor:
    return state.once("angle", lambda: rotation_angle(rotation_difference(state, "cup/quaternion")))

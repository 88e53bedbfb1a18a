"""LiftUnderarm: appendix A.2.6; docs/figures.md, classes."""

import math

import torch
from torch import Tensor

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.poses import PALM_UP_AWAY, PALM_UP_BACK, HandPose
from bidex_meta.tasks.base import FAST
from bidex_meta.tasks.goals import frozen_goal
from bidex_meta.tasks.layout import goal_blocks, handle_blocks, object_blocks
from bidex_meta.tasks.objects.pointed import OwnObjectClass
from bidex_meta.tasks.placement import DRAWS, placed, yaw_quaternion
from bidex_meta.tasks.scene import SceneObject, Table
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import component, join
from bidex_meta.utils.maths import norm, uprightness

_START = (0.0, -0.6, 0.465)
_GOAL_SHIFT = 0.05
_GOAL_HEIGHT = (0.25, 0.45)
_SUCCESS_DISTANCE = 0.05
_SUCCESS_TILT = math.radians(30.0)


class LiftUnderarm(OwnObjectClass):
    """Lift a pot off a table by its two grips.

    Observation: Table 18 (428). Reward: equation 6. The goal lies 25 to 45 cm above the task's own start and up to 5 cm
    beside it, and has the start's orientation, yaw included. The pot starts at rest on the table; at the original's
    height it would start 1.5 cm inside. Friction: 3 on the table, 2 between wall and hand.
    """

    needs = Capacity(36, 4, 82)
    name = "LiftUnderarm"
    summary = "Lift a pot off a table by its two grips"
    formula = "0.2 - d_left - d_right + 3 (0.985 - d), d from the pot to its goal"
    solved = "pot within 5 cm of its goal and within 30 degrees of upright"
    deviations = (
        "Success asks for an upright pot too; reward and the original's success count its place alone.",
        "The pot's inertia follows from its shape (3 kg, lid 1 kg); the original's is far too large for the size.",
    )
    episode_steps = 500
    right = HandPose((0.0, 0.05, 0.45), PALM_UP_AWAY)
    left = HandPose((0.0, -1.25, 0.45), PALM_UP_BACK)
    transition_scale, orientation_scale = 0.25, 1.0
    start_draws = DRAWS
    solver = FAST
    table = Table((0.3, 0.3, 0.4), (0.0, -0.6, 0.2), friction=3.0)
    objects = (SceneObject("object", "pot", _START),)
    points = ("object/left_handle_position", "object/right_handle_position")
    constant = 0.2
    ghost = (0.12, 0.12, 0.06)
    camera_target, camera_distance = (0.0, -0.6, 0.55), 1.5
    variation_space = join(
        placed("object"),
        *(component(f"goal_{axis}", -_GOAL_SHIFT, _GOAL_SHIFT) for axis in "xy"),
        component("goal_height", *_GOAL_HEIGHT),
    )
    blocks = (
        *object_blocks("object"),
        *goal_blocks("goal"),
        *handle_blocks("object", "beside the grip at +y", "beside the grip at -y"),
    )

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """``object``: the pot's placement (n, 3); ``goal``: pose (n, 7); ``goal_inverse``: inverse rotation (n, 4)."""
        placement = variation[:, :3]
        start = torch.cat((placement[:, :2], torch.zeros_like(placement[:, :1])), dim=1) + placement.new_tensor(_START)
        goal = torch.cat((start + variation[:, 3:], yaw_quaternion(placement[:, 2])), dim=1)
        return {"object": placement, **frozen_goal(goal)}

    def target(self, state: TaskState) -> Tensor:
        return 3.0 * (0.985 - self._distance(state))

    def success(self, state: TaskState) -> Tensor:
        upright = uprightness(state.quaternion("object/quaternion")) > math.cos(_SUCCESS_TILT)
        return (self._distance(state) < _SUCCESS_DISTANCE) & upright

    def _distance(self, state: TaskState) -> Tensor:
        return state.once("distance", lambda: norm(state["object/position"] - state.frozen["goal"][:, :3]))

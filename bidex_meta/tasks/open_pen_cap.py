"""OpenPenCap: appendix A.2.14; docs/figures.md, classes."""

import math
from dataclasses import replace

import mujoco
import torch
from torch import Tensor

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.poses import PALM_DOWN_AHEAD, HandPose
from bidex_meta.tasks.base import THIN
from bidex_meta.tasks.goals import frozen_goal
from bidex_meta.tasks.layout import goal_blocks, object_blocks, point_block
from bidex_meta.tasks.placement import DRAWS, place, placed
from bidex_meta.tasks.reach import ReachTask, apart
from bidex_meta.tasks.scene import SceneObject, Table
from bidex_meta.tasks.state import TaskState
from bidex_meta.utils.maths import rotate, xyzw

_PEN = SceneObject("pen", "pen", (0.0, 0.0, 0.612), (0.5 * math.pi, 0.5 * math.pi, 0.0))
_OPEN = 0.3
_BODY_POINT = 0.07
"""Where the body point lies on the pen's axis, metres; the cap's point lies towards the other end."""


class OpenPenCap(ReachTask):
    """Pull the cap off a pen that lies on a table: the left hand at its body, the right hand at its cap.

    Observation: Table 34 (428). Reward: equation 16. Success is a cap pulled 13 cm, its own length. Goal position is
    the cap's point at 0.3 m with the body at the task's start, goal orientation the pen's there; reward and success do
    not read them.
    """

    needs = Capacity(56, 0, 121)
    name = "OpenPenCap"
    summary = "Pull the cap off a pen"
    formula = "exp(-10 d_left) + exp(-10 d_right) + 5 d - 0.8, d between the points on body and cap"
    solved = "points on body and cap more than 0.3 m apart"
    deviations = ("The pen lies on flats; the original's rolls.",)
    episode_steps = 125
    right = HandPose((0.55, 0.2, 0.8), PALM_DOWN_AHEAD)
    left = HandPose((0.55, -0.2, 0.8), PALM_DOWN_AHEAD)
    transition_scale, orientation_scale = 0.5, 0.1
    start_draws = DRAWS
    solver = replace(THIN, integrator=mujoco.mjtIntegrator.mjINT_IMPLICIT)
    table = Table((0.5, 1.0, 0.6), (0.0, 0.0, 0.3))
    objects = (_PEN,)
    points = ("pen/body_position", "pen/cap_position")
    constant = -0.8
    exponential = True
    ghost = (0.012, 0.012, 0.012)
    camera_target = (0.12, 0.0, 0.66)
    variation_space = placed("pen")
    blocks = (
        *object_blocks("pen"),
        *goal_blocks("goal"),
        point_block("pen_body_position", "pen/body_position", "point on the pen's body for the left hand"),
        point_block("pen_cap_position", "pen/cap_position", "point on the pen's cap for the right hand"),
    )

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """``pen``: place (n, 3); ``goal``: pose (n, 7); ``goal_inverse``: inverse of its rotation (n, 4)."""
        pen = variation.new_tensor((*_PEN.position, *_PEN.quaternion)).repeat(len(variation), 1)
        place(pen, variation)
        rotation = xyzw(pen[:, 3:])
        cap = pen[:, :3] + rotate(rotation, pen.new_tensor((0.0, 0.0, _BODY_POINT - _OPEN)))
        return {"pen": variation, **frozen_goal(torch.cat((cap, rotation), dim=1))}

    def target(self, state: TaskState) -> Tensor:
        return 5.0 * apart(state, *self.points)

    def success(self, state: TaskState) -> Tensor:
        return apart(state, *self.points) > _OPEN

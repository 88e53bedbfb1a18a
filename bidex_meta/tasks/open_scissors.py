"""OpenScissors: appendix A.2.12; docs/figures.md, classes."""

import math

import torch
from torch import Tensor

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.poses import PALM_DOWN_AHEAD, HandPose
from bidex_meta.tasks.base import THIN
from bidex_meta.tasks.layout import goal_blocks, handle_blocks, object_blocks
from bidex_meta.tasks.placement import DRAWS, place, placed, yaw_quaternion
from bidex_meta.tasks.reach import ReachTask
from bidex_meta.tasks.scene import SceneObject, Table
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import component, join
from bidex_meta.utils.maths import conjugate, constant, multiply, rotate, xyzw

_SCISSORS = SceneObject("scissors", "scissors", (0.0, 0.0, 0.608), (0.0, 0.0, 0.5 * math.pi))
_SHUT = -0.59
"""Hinge angle at the start, rad."""
_TOLERANCE = 0.1
_PIVOT, _RIGHT_HANDLE = (-0.0034, 0.0698, 0.0), (0.1, -0.2, 0.0)
"""The pivot on the left hand's half, and the right handle's point from there on the other half, metres
(docs/figures.md, objects)."""


class OpenScissors(ReachTask):
    """Open shears that lie on a table by a task's angle, each hand at its loop.

    Observation: Table 30 (428). Reward: equation 14. The formula leaves the target angle open: a task freezes it (0 is
    34 degrees open; shut, where episodes start, is -0.59). The object pose is that of the left hand's half. The goal
    block is of the half that moves: its handle's point and its orientation at the target angle, with the other half
    where it is now; the rotation difference is that half's too, so that it shows the missing angle.
    """

    needs = Capacity(57, 0, 131)
    name = "OpenScissors"
    summary = "Open shears to a given angle with both hands"
    formula = "2 - d_left - d_right + 5 (0.59 - r), r the angle between the hinge and its target"
    solved = "hinge within 0.1 rad of its target"
    deviations = (
        "The loops are hollow; the original's are filled.",
        "The goal block moves with the shears.",
    )
    episode_steps = 150
    right = HandPose((0.55, 0.2, 0.8), PALM_DOWN_AHEAD)
    left = HandPose((0.55, -0.2, 0.8), PALM_DOWN_AHEAD)
    transition_scale, orientation_scale = 0.5, 0.1
    start_draws = DRAWS
    solver = THIN
    table = Table((0.5, 1.0, 0.6), (0.0, 0.0, 0.3))
    objects = (_SCISSORS,)
    points = ("scissors/left_handle_position", "scissors/right_handle_position")
    constant = 2.0
    camera_target = (0.08, 0.0, 0.66)
    variation_space = join(placed("scissors"), component("target_angle", -0.15, 0.3))
    blocks = (
        *object_blocks("scissors"),
        *goal_blocks("goal"),
        *handle_blocks("scissors", "in the right hand's loop", "in the left hand's loop"),
    )

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """``scissors``: place (n, 3); ``target``: angle (n, 1); ``turn``: quaternion (n, 4); ``ghost``: pose (n, 7)."""
        root = variation.new_tensor((*_SCISSORS.position, *_SCISSORS.quaternion)).repeat(len(variation), 1)
        place(root, variation[:, :3])
        turn = yaw_quaternion(variation[:, 3])
        ghost = _opened(root[:, :3], xyzw(root[:, 3:]), turn)
        return {"scissors": variation[:, :3], "target": variation[:, 3:], "turn": turn, "ghost": ghost}

    def start(self, draws: Tensor, frozen: dict[str, Tensor], qpos: dict[str, Tensor]) -> None:
        super().start(draws, frozen, qpos)
        qpos["scissors/hinge"].fill_(_SHUT)

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        rotation = state.quaternion("scissors/quaternion")
        goal = _opened(state["scissors/position"], rotation, state.frozen["turn"])
        missing = multiply(state.quaternion("scissors/half_quaternion"), conjugate(goal[:, 3:]))
        return {"goal_pose": goal, "goal_rotation_difference": missing}

    def target(self, state: TaskState) -> Tensor:
        return 5.0 * (0.59 - _missing(state))

    def success(self, state: TaskState) -> Tensor:
        return _missing(state) < _TOLERANCE

    def ghosts(self, frozen: dict[str, Tensor]) -> list[tuple[Tensor, tuple[float, float, float]]]:
        return [(frozen["ghost"], (0.02, 0.02, 0.01))]


def _opened(position: Tensor, rotation: Tensor, turn: Tensor) -> Tensor:
    """Pose (n, 7) of the right handle's point on the half that is opened by ``turn`` (n, 4) from the other half."""
    opened = multiply(rotation, turn)
    pivot = position + rotate(rotation, constant(_PIVOT, position))
    return torch.cat((pivot + rotate(opened, constant(_RIGHT_HANDLE, position)), opened), dim=1)


def _missing(state: TaskState) -> Tensor:
    return state.once("missing", lambda: (state["scissors/angle"] - state.frozen["target"]).abs()[:, 0])

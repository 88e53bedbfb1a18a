"""Switch: appendix A.2.15; docs/figures.md, classes."""

import math

import torch
from torch import Tensor

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.poses import PALM_DOWN_AHEAD, HandPose
from bidex_meta.tasks.base import FAST
from bidex_meta.tasks.goals import frozen_goal
from bidex_meta.tasks.layout import goal_blocks, object_blocks, point_block
from bidex_meta.tasks.placement import SHIFT
from bidex_meta.tasks.reach import ReachTask
from bidex_meta.tasks.scene import SceneObject, Table
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import component, join
from bidex_meta.utils.maths import norm, quaternion_from_rpy, quaternion_product, xyzw

_NAMES = ("switch1", "switch2")
_FACE_UP = (math.pi, 0.5 * math.pi, 0.0)
_TRAVEL = 0.5585
_PRESSED = (-0.0241, -0.001, 0.0427)
"""The button point at full travel from the base, world axes: hinge origin and point lie flush with the face there."""
_PRESSED_QUATERNION = quaternion_product(quaternion_from_rpy(_FACE_UP), quaternion_from_rpy((0.0, _TRAVEL, 0.0)))
"""Orientation (w, x, y, z) of the rocker at full travel."""
_SUCCESS_ANGLE = 0.8 * _TRAVEL


class Switch(ReachTask):
    """Press the buttons of two rocker switches.

    Table 0.5 x 1 x 0.55 m. Observation: Table 36 (428). Reward: equation 17. The half of each rocker that stands proud
    is the button, its point 3.5 cm from the hinge on the surface, its target the same point at full travel. Switch 1 is
    the one at -y, the left hand's. The entries of switch 1's pose and velocity are its rocker's, since the housing does
    not move. The goal block holds switch 1's target and its rocker's orientation there. A task freezes where the
    housings stand, 3 cm around the nominal place, unturned; an episode draws nothing.
    """

    needs = Capacity(36, 0, 90)
    name = "Switch"
    summary = "Press the buttons of two rocker switches"
    formula = "2 - d_left - d_right + 50 (1.4 - d), d the sum of both buttons' distances to where they are pressed"
    solved = "both rockers past 80 % of their travel"
    deviations = (
        "A button's target is its own point at full travel; the original asks for a height it cannot reach.",
        "Tasks shift the housings, but do not turn them.",
    )
    episode_steps = 125
    right = HandPose((0.55, 0.2, 0.8), PALM_DOWN_AHEAD)
    left = HandPose((0.55, -0.2, 0.8), PALM_DOWN_AHEAD)
    transition_scale, orientation_scale = 0.5, 0.1
    start_draws = 0
    solver = FAST
    table = Table((0.5, 1.0, 0.55), (0.0, 0.0, 0.275))
    objects = (
        SceneObject("switch1", "switch", (0.0, -0.2, 0.65), _FACE_UP),
        SceneObject("switch2", "switch", (0.0, 0.2, 0.65), _FACE_UP),
    )
    points = ("switch1/button_position", "switch2/button_position")
    constant = 2.0
    camera_target, camera_distance = (0.08, 0.0, 0.70), 1.1
    variation_space = join(*(component(f"switch{i}_{axis}", -SHIFT, SHIFT) for i in (1, 2) for axis in "xy"))
    blocks = (
        *object_blocks("switch1"),
        *goal_blocks("goal"),
        point_block("switch1_position", "switch1/button_position", "point on the rocker's proud half"),
        point_block("switch2_position", "switch2/button_position", "point on the rocker's proud half"),
    )

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """Base positions, targets of the button points ``goal1``, ``goal2`` (n, 3); ``goal``: switch 1's pose."""
        frozen = {}
        for i, switch in enumerate(self.objects, start=1):
            position = variation.new_tensor(switch.position).repeat(len(variation), 1)
            position[:, :2] += variation[:, 2 * i - 2 : 2 * i]
            frozen |= {switch.name: position, f"goal{i}": position + variation.new_tensor(_PRESSED)}
        turn = xyzw(variation.new_tensor(_PRESSED_QUATERNION)).expand(len(variation), 4)
        return frozen | frozen_goal(torch.cat((frozen["goal1"], turn), dim=1))

    def start(self, draws: Tensor, frozen: dict[str, Tensor], qpos: dict[str, Tensor]) -> None:
        for name in _NAMES:
            qpos[name][:, :3] = frozen[name]

    def target(self, state: TaskState) -> Tensor:
        first, second = (norm(state[f"switch{i}/button_position"] - state.frozen[f"goal{i}"]) for i in (1, 2))
        return 50.0 * (1.4 - (first + second))

    def success(self, state: TaskState) -> Tensor:
        first, second = (state[f"{name}/angle"][:, 0] for name in _NAMES)
        return (first > _SUCCESS_ANGLE) & (second > _SUCCESS_ANGLE)

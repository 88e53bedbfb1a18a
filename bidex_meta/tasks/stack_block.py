"""StackBlock: appendix A.2.16; docs/figures.md, classes."""

import mujoco
import torch
from torch import Tensor

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.poses import PALM_DOWN_AWAY, PALM_DOWN_BACK, HandPose
from bidex_meta.tasks.base import FIRM
from bidex_meta.tasks.layout import goal_blocks, object_blocks, point_block
from bidex_meta.tasks.placement import DRAWS, placed
from bidex_meta.tasks.reach import ReachTask
from bidex_meta.tasks.scene import SceneObject, Table
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import component, join
from bidex_meta.utils.maths import norm

_EDGE = 0.05
"""Edge of a block, metres."""
_BOTTOM = (0.0, 0.0, 0.625)
"""Middle of the places where the bottom block shall stand, world, metres."""
_TARGET_RANGE = 0.03
_SUCCESS_DISTANCE = 0.03
_SUCCESS_HEIGHT = 0.01
"""Block 1 is on block 2 when its centre is one edge higher, give or take this, metres."""
_BLOCK_FRICTION = 0.375
"""Mean of the original's 0.25 for blocks and 0.5 for hands (docs/figures.md, friction)."""
_TABLE_FRICTION = 0.225
"""Mean of the original's 0.25 for blocks and 0.2 for the table."""


class StackBlock(ReachTask):
    """Stack two blocks: the left hand's block 1 on the right hand's block 2.

    Table 0.5 x 1 m, 60 cm high. Observation: Table 38 (428); its goal is the top block's: target 1, upright and
    unturned (the reward asks for no turn). Reward: equation 18. Success: each block within 3 cm of its target and block
    1 on block 2: one edge higher within 1 cm, and within 3 cm above its middle. A task shifts and turns both blocks and
    shifts the targets by up to 3 cm along x and y. Frictions are the means of the original's figures.
    """

    needs = Capacity(43, 0, 115)
    name = "StackBlock"
    summary = "Stack two blocks at a given place"
    formula = "1.5 - d_left - d_right + 2 (0.24 - d), d the sum of both blocks' distances to their targets"
    solved = "both blocks within 3 cm of their targets, block 1 on block 2"
    deviations = (
        "The printed formula names target 1 twice; here each block has its own.",
        "Friction of block on block is 0.375 instead of 0.25, of hand on table 0.225 instead of 0.35.",
    )
    episode_steps = 250
    right = HandPose((0.0, 0.6, 0.7), PALM_DOWN_AWAY)
    left = HandPose((0.0, -0.6, 0.7), PALM_DOWN_BACK)
    transition_scale, orientation_scale = 0.2, 0.02
    start_draws = 2 * DRAWS
    solver = FIRM
    table = Table((0.5, 1.0, 0.6), (0.0, 0.0, 0.3), _TABLE_FRICTION, priority=2)
    objects = (
        SceneObject("block1", "cube", (0.0, -0.1, 0.625), colour=(0.85, 0.43, 0.30, 1.0)),
        SceneObject("block2", "cube", (0.0, 0.1, 0.625)),
    )
    points = ("block1/position", "block2/position")
    constant = 1.5
    terms = ("constant", "left", "right", "target")
    camera_target, camera_distance = (0.0, 0.0, 0.66), 1.5
    variation_space = join(
        placed("block1"),
        placed("block2"),
        *(component(f"target_{axis}", -_TARGET_RANGE, _TARGET_RANGE) for axis in "xy"),
    )
    blocks = (
        *object_blocks("block1"),
        *goal_blocks("goal"),
        point_block("block1_position", "block1/position", "centre of block 1"),
        point_block("block2_position", "block2/position", "centre of block 2"),
    )

    def add_objects(self, scene: mujoco.MjSpec) -> None:
        super().add_objects(scene)
        for block in self.objects:
            cube = scene.geom(f"{block.name}/cube")
            cube.friction[0], cube.priority = _BLOCK_FRICTION, 1

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """``block1``, ``block2``: shifts, turns (n, 3); ``goal``: the top block's pose (n, 7); ``target2`` (n, 3)."""
        shift = torch.cat((variation[:, 6:8], torch.zeros_like(variation[:, :1])), dim=1)
        bottom = shift + shift.new_tensor(_BOTTOM)
        top = bottom + shift.new_tensor((0.0, 0.0, _EDGE))
        turn = shift.new_tensor((0.0, 0.0, 0.0, 1.0)).expand(len(shift), 4)
        return super().freeze(variation) | {"goal": torch.cat((top, turn), dim=1), "target2": bottom}

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        return {"goal_pose": state.frozen["goal"], "goal_rotation_difference": state.quaternion("block1/quaternion")}

    def target(self, state: TaskState) -> Tensor:
        first, second = self._distances(state)
        return 2.0 * (0.24 - (first + second))

    def success(self, state: TaskState) -> Tensor:
        first, second = self._distances(state)
        x, y, z = (state["block1/position"] - state["block2/position"]).unbind(1)
        stacked = ((z - _EDGE).abs() < _SUCCESS_HEIGHT) & ((x * x + y * y).sqrt() < _SUCCESS_DISTANCE)
        return (first < _SUCCESS_DISTANCE) & (second < _SUCCESS_DISTANCE) & stacked

    def _distances(self, state: TaskState) -> tuple[Tensor, Tensor]:
        first = state["block1/position"] - state.frozen["goal"][:, :3]
        return norm(first), norm(state["block2/position"] - state.frozen["target2"])

    def ghosts(self, frozen: dict[str, Tensor]) -> list[tuple[Tensor, tuple[float, float, float]]]:
        bottom = torch.cat((frozen["target2"], frozen["goal"][:, 3:]), dim=1)
        return [(frozen["goal"], (0.025, 0.025, 0.025)), (bottom, (0.025, 0.025, 0.025))]

"""PushBlock: appendix A.2.10; docs/figures.md, classes."""

import mujoco
import torch
from torch import Tensor

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.poses import PALM_DOWN_AHEAD, HandPose
from bidex_meta.tasks.base import FAST, TaskClass
from bidex_meta.tasks.layout import object_blocks, point_block
from bidex_meta.tasks.placement import DRAWS, place_all, placed
from bidex_meta.tasks.reach import reach
from bidex_meta.tasks.scene import SceneObject, add_table
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import join
from bidex_meta.utils.maths import norm

_STARTS = {"block1": (0.0, -0.2, 0.625), "block2": (0.0, 0.2, 0.625)}
_GOALS = {"block1": (-0.2, -0.2, 0.625), "block2": (-0.2, 0.2, 0.625)}
_SUCCESS_DISTANCE = 0.1
"""Each block within this distance of its goal, metres."""
_TABLE_FRICTION = 0.75
"""Mean of the original's 0.5 and of 1 for hands and blocks (docs/figures.md, friction)."""


class PushBlock(TaskClass):
    """Push two blocks on a table, one with each hand, 20 cm away to their goals.

    Table 1 x 1 m, 60 cm high. Observation: Table 26 (417), without the goals; so these are fixed and the starts vary: a
    task shifts and turns each block. Reward: equation 12. Block 1 is the one on the left hand's side (-y).
    """

    needs = Capacity(38, 0, 103)
    name = "PushBlock"
    summary = "Push two blocks to their goals, one with each hand"
    formula = "2 - d_left - d_right + 5 (0.8 - d), d the sum of both blocks' distances to their goals"
    solved = "both blocks within 10 cm of their goals"
    deviations = ("The blocks start on the table, not in it; the original's half success for one block is left out.",)
    episode_steps = 125
    right = HandPose((0.55, 0.2, 0.8), PALM_DOWN_AHEAD)
    left = HandPose((0.55, -0.2, 0.8), PALM_DOWN_AHEAD)
    transition_scale = 0.5
    orientation_scale = 0.1
    start_draws = 2 * DRAWS
    solver = FAST
    camera_target = (0.1, 0.0, 0.68)
    camera_distance = 1.7

    variation_space = join(placed("block1"), placed("block2"))
    """Shift and turn of both blocks."""

    blocks = (
        *object_blocks("block1", "block1"),
        point_block("block1_position", "block1/position", "centre of block 1"),
        point_block("block2_position", "block2/position", "centre of block 2"),
    )

    def add_objects(self, scene: mujoco.MjSpec) -> None:
        add_table(scene, (1.0, 1.0, 0.6), (0.0, 0.0, 0.3), friction=_TABLE_FRICTION, priority=1)
        SceneObject("block1", "cube", _STARTS["block1"], colour=(0.85, 0.43, 0.30, 1.0)).add_to(scene)
        SceneObject("block2", "cube", _STARTS["block2"]).add_to(scene)

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """``block1``, ``block2``: shifts and turns; ``goal1``, ``goal2``: goal positions; each (n, 3)."""
        goals = [variation.new_tensor(goal).expand(len(variation), 3) for goal in _GOALS.values()]
        return {"block1": variation[:, :3], "block2": variation[:, 3:], "goal1": goals[0], "goal2": goals[1]}

    def start(self, draws: Tensor, frozen: dict[str, Tensor], qpos: dict[str, Tensor]) -> None:
        place_all(_STARTS, qpos, frozen, draws)

    def reward_terms(self, state: TaskState) -> dict[str, Tensor]:
        """``constant`` 2, ``left`` -d_left, ``right`` -d_right, ``target`` 5 (0.8 - d_target)."""
        left, right = reach(state, "left", "block1/position"), reach(state, "right", "block2/position")
        first, second = self._distances(state)
        return {
            "constant": torch.full_like(left, 2.0),
            "left": -left,
            "right": -right,
            "target": 5.0 * (0.8 - (first + second)),
        }

    def success(self, state: TaskState) -> Tensor:
        first, second = self._distances(state)
        return (first <= _SUCCESS_DISTANCE) & (second <= _SUCCESS_DISTANCE)

    def _distances(self, state: TaskState) -> tuple[Tensor, Tensor]:
        """Distance (m) of each block from its goal, each (n,)."""
        first, second = (state[f"block{i}/position"] - state.frozen[f"goal{i}"] for i in (1, 2))
        return norm(first), norm(second)

    def ghosts(self, frozen: dict[str, Tensor]) -> list[tuple[Tensor, tuple[float, float, float]]]:
        goals = [frozen["goal1"], frozen["goal2"]]
        turn = goals[0].new_tensor((0.0, 0.0, 0.0, 1.0)).expand(len(goals[0]), 4)
        return [(torch.cat((goal, turn), dim=1), (0.025, 0.025, 0.025)) for goal in goals]

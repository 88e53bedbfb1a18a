"""PushBlock: appendix A.2.10; docs/figures.md, classes."""

import torch
from torch import Tensor

from bidex_meta.engine.capacity import Capacity
from bidex_meta.hands.poses import PALM_DOWN_AHEAD, HandPose
from bidex_meta.tasks.base import FAST
from bidex_meta.tasks.layout import object_blocks, point_block
from bidex_meta.tasks.placement import DRAWS, placed
from bidex_meta.tasks.reach import ReachTask
from bidex_meta.tasks.scene import SceneObject, Table
from bidex_meta.tasks.state import TaskState
from bidex_meta.tasks.variation import join
from bidex_meta.utils.maths import norm

_GOALS = ((-0.2, -0.2, 0.625), (-0.2, 0.2, 0.625))
_SUCCESS_DISTANCE = 0.1
"""Each block within this distance of its goal, metres."""
_TABLE_FRICTION = 0.75
"""Mean of the original's 0.5 and of 1 for hands and blocks (docs/figures.md, friction)."""


class PushBlock(ReachTask):
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
    transition_scale, orientation_scale = 0.5, 0.1
    start_draws = 2 * DRAWS
    solver = FAST
    table = Table((1.0, 1.0, 0.6), (0.0, 0.0, 0.3), _TABLE_FRICTION, priority=1)
    objects = (
        SceneObject("block1", "cube", (0.0, -0.2, 0.625), colour=(0.85, 0.43, 0.30, 1.0)),
        SceneObject("block2", "cube", (0.0, 0.2, 0.625)),
    )
    points = ("block1/position", "block2/position")
    constant = 2.0
    terms = ("constant", "left", "right", "target")
    camera_target, camera_distance = (0.1, 0.0, 0.68), 1.7
    variation_space = join(placed("block1"), placed("block2"))
    blocks = (
        *object_blocks("block1"),
        point_block("block1_position", "block1/position", "centre of block 1"),
        point_block("block2_position", "block2/position", "centre of block 2"),
    )

    def freeze(self, variation: Tensor) -> dict[str, Tensor]:
        """``block1``, ``block2``: shifts and turns; ``goal1``, ``goal2``: goal positions; each (n, 3)."""
        first, second = (variation.new_tensor(goal).expand(len(variation), 3) for goal in _GOALS)
        return super().freeze(variation) | {"goal1": first, "goal2": second}

    def target(self, state: TaskState) -> Tensor:
        first, second = self._distances(state)
        return 5.0 * (0.8 - (first + second))

    def success(self, state: TaskState) -> Tensor:
        first, second = self._distances(state)
        return (first <= _SUCCESS_DISTANCE) & (second <= _SUCCESS_DISTANCE)

    def _distances(self, state: TaskState) -> tuple[Tensor, Tensor]:
        first, second = (state[f"block{i}/position"] - state.frozen[f"goal{i}"] for i in (1, 2))
        return norm(first), norm(second)

    def ghosts(self, frozen: dict[str, Tensor]) -> list[tuple[Tensor, tuple[float, float, float]]]:
        goals = [frozen["goal1"], frozen["goal2"]]
        turn = goals[0].new_tensor((0.0, 0.0, 0.0, 1.0)).expand(len(goals[0]), 4)
        return [(torch.cat((goal, turn), dim=1), (0.025, 0.025, 0.025)) for goal in goals]

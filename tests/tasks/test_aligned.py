"""The reward of version 2: one where solved, and less elsewhere; and success, against ``wide``."""

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from bidex_meta.tasks import registry
from bidex_meta.world.part import judgement_of
from tests.tasks import wide
from tests.tasks.formulas import FORMULAS
from tests.tasks.worlds import Lens, engine_of, scene_of, set_pose, task_of, world_of

ROWS = 100


def check_range(reward: Tensor, solved: Tensor) -> None:
    assert (reward >= 0.0).all() and (reward[solved] == 1.0).all() and (reward[~solved] <= 0.9 + 1e-6).all()


@pytest.mark.parametrize("rounds", [6, pytest.param(500, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", registry.names())
def test_the_reward_is_one_where_solved_and_at_most_nine_tenths_elsewhere(name: str, rounds: int) -> None:
    """In a rollout, and in states about goals, of which some are judged by plain numbers."""
    world = world_of(f"{name}-v2", True, ROWS, tasks=ROWS)
    world.reset(seed=0)
    engine, everyone, (part,) = engine_of(world), torch.ones(ROWS, dtype=torch.bool), world.parts
    rng, lens, count, seen = np.random.default_rng(0), Lens(scene_of(world).model), 0, [0, 0]
    start, tasks = engine.placement().clone(), [task_of(world, row) for row in range(ROWS)]
    for i in range(rounds):
        engine.reset(everyone, start)
        for row, task in enumerate(tasks):
            drawn = (FORMULAS[name].scatter if i % 4 == 3 else lambda *of: wide.near(name, *of))(lens.data, task, rng)
            for body, values in drawn.items():
                set_pose(world, row, body, values)
        engine.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
        ((member, _, state),) = part.states(world.task_index)
        judged = judgement_of(member.scene.task, state)
        check_range(judged.reward, judged.success)
        count += int(judged.success.sum())
        for row in range(i % 3, ROWS, 3):
            solved, margin = wide.solved(name, lens.look(engine.placement()[row]), tasks[row])
            if margin > 1e-6:
                assert bool(judged.success[row]) == solved, row
                seen[int(solved)] += 1
    assert min(seen) >= 3 and 0.02 * rounds * ROWS < count < 0.9 * rounds * ROWS, (seen, count)
    world.reset(seed=2)
    for action in 2 * torch.rand(4, ROWS, world.action_size, generator=torch.Generator().manual_seed(0)) - 1:
        _, reward, *_, info = world.step(action)
        valid = ~info["unstable"]
        check_range(reward[valid], info["solved"][valid])

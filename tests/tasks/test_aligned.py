"""The reward of version 2: its range, where it is one, and its formula, against ``wide``."""

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from bidex_meta.tasks import registry
from bidex_meta.world import World
from bidex_meta.world.part import judge
from tests.tasks import wide
from tests.tasks.formulas import FORMULAS
from tests.tasks.worlds import Lens, engine_of, scene_of, set_pose, task_of, world_of

ROWS = 100
each_class = pytest.mark.parametrize("name", registry.names())


def scattered(world: World, name: str, rounds: int, seed: int = 0):
    """Reward and success (n,) of states about goals, round by round: near, and as version 1 scatters them."""
    rng, engine, lens = np.random.default_rng(seed), engine_of(world), Lens(scene_of(world).model)
    start, (part,) = engine.placement().clone(), world.parts
    tasks, everyone = [task_of(world, row) for row in range(ROWS)], torch.ones(ROWS, dtype=torch.bool)
    for i in range(rounds):
        engine.reset(everyone, start)
        for row, task in enumerate(tasks):
            chosen = FORMULAS[name].scatter if i % 4 == 3 else lambda *of: wide.near(name, *of)
            for body, values in chosen(lens.data, task, rng).items():
                set_pose(world, row, body, values)
        engine.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
        ((member, _, state),) = part.states(world.task_index)
        judged = judge(member.scene.task, state)
        yield judged.reward, judged.success


def check_range(reward: Tensor, solved: Tensor) -> None:
    assert (reward >= 0.0).all() and (reward[solved] == 1.0).all() and (reward[~solved] <= 0.9 + 1e-6).all()


def check_many(name: str, rounds: int) -> None:
    world = world_of(f"{name}-v2", True, ROWS, tasks=ROWS)
    world.reset(seed=0)
    count = 0
    for reward, solved in scattered(world, name, rounds):
        check_range(reward, solved)
        count += int(solved.sum())
    assert 0.02 * rounds * ROWS < count < 0.9 * rounds * ROWS, count


@each_class
def test_the_reward_is_one_where_solved_and_at_most_nine_tenths_elsewhere(name: str) -> None:
    check_many(name, 12)


@pytest.mark.slow
@each_class
def test_so_it_is_in_a_million_states(name: str) -> None:
    check_many(name, 500)


@each_class
def test_in_rollouts_and_against_plain_numbers(name: str) -> None:
    """The formula and success of states near goals; in rollouts the range, and terms that sum to the reward."""
    world = world_of(f"{name}-v2", True, ROWS, tasks=ROWS)
    world.reset(seed=1)
    lens, seen = Lens(scene_of(world).model), [0, 0]
    for found, success in scattered(world, name, 4, seed=1):
        placement = engine_of(world).placement()
        for row in range(0, ROWS, 4):
            wanted, solved, margin = wide.reward(name, lens.look(placement[row]), task_of(world, row))
            if margin > 1e-6:
                assert bool(success[row]) == solved and float(found[row]) == pytest.approx(wanted, abs=1e-6), row
                seen[solved] += 1
    assert min(seen) >= 3, seen
    world.reset(seed=2)
    for action in 2 * torch.rand(4, ROWS, world.action_size, generator=torch.Generator().manual_seed(0)) - 1:
        _, reward, *_, info = world.step(action)
        valid = ~info["unstable"]
        check_range(reward[valid], info["solved"][valid])
        terms = torch.stack(list(info["reward_terms"].values())).sum(dim=0)
        torch.testing.assert_close(terms[valid], reward[valid], rtol=0, atol=1e-6)

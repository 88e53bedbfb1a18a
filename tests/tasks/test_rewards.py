"""Reward, success and ends of every class against the printed formulas, computed from MuJoCo's own state."""

import numpy as np
import pytest
import torch

from bidex_meta.world import World
from tests.tasks.formulas import FAILING, FORMULAS
from tests.tasks.worlds import Lens, each_case, engine_of, mixed_world, scene_of, set_pose, task_of, world_of

ROWS, STEPS = 12, 40


def judgements(world: World, name: str, lens: Lens) -> list:
    placement = engine_of(world).placement()
    return [FORMULAS[name].judge(lens.look(placement[row]), task_of(world, row)) for row in range(world.num_envs)]


def compare(active: np.ndarray, told: list, reward: np.ndarray, info: dict, scale: float = 1.0) -> None:
    """Rows that were stepped: unscaled and returned reward, and every term."""
    for row in np.flatnonzero(active):
        right = sum(told[row].terms.values())
        bound = 1e-5 * max(1.0, abs(right))
        assert abs(float(info["reward_unscaled"][row]) - right) <= bound, row
        assert abs(float(reward[row]) - scale * right) <= bound, row
        for term, value in told[row].terms.items():
            assert abs(float(info["reward_terms"][term][row]) - value) <= bound, (row, term)


def scatter(world: World, name: str, lens: Lens, rng: np.random.Generator) -> None:
    """Moves some rows to where success and failure are decided."""
    placement = engine_of(world).placement()
    for row in range(0, world.num_envs, 2):
        parts = FORMULAS[name].scatter(lens.look(placement[row]), task_of(world, row), rng)
        for part, values in parts.items():
            set_pose(world, row, part, values)


def fling(world: World, row: int) -> None:
    """Puts both moving bases of a row beyond every anchor."""
    engine, scene = engine_of(world), scene_of(world)
    for side in ("right", "left"):
        if f"{side}/base" in scene.qpos:
            engine.qpos[row, scene.qpos[f"{side}/base"].start + 2] += 0.2


@each_case
def test_rewards_success_and_ends_are_the_printed_ones(name: str, moving: bool) -> None:
    """Random rollouts with resets, half of the rows moved about the places where it matters."""
    world = world_of(name, moving, ROWS, tasks=5)
    lens, rng = Lens(scene_of(world).model), np.random.default_rng(0)
    generator = torch.Generator().manual_seed(0)
    world.reset(seed=1)
    seen = {"success": 0, "failure": 0, "reset": 0, "rows": 0}
    for step in range(STEPS):
        if step % 3 == 0:
            scatter(world, name, lens, rng)
        if step % 20 == 7:
            fling(world, 1)
        active = ~world.episodes.finished.numpy()
        action = torch.rand(ROWS, world.action_size, generator=generator) * 2 - 1
        _, reward, terminated, truncated, info = world.step(action)
        active &= ~info["unstable"].numpy()
        told = judgements(world, name, lens)
        compare(active, told, reward.numpy(), info)
        terms = torch.stack(list(info["reward_terms"].values())).sum(dim=0)
        np.testing.assert_allclose(terms.numpy(), info["reward_unscaled"].numpy(), atol=1e-6)
        for row in np.flatnonzero(active):
            if told[row].margin > 1e-9:
                assert bool(info["success"][row]) == told[row].success, (step, row, told[row])
                assert bool(terminated[row]) == told[row].failed, (step, row, told[row])
            seen["success"] += told[row].success
            seen["failure"] += told[row].failed
            seen["rows"] += 1
        ended = terminated | truncated
        if step % 15 == 14:
            ended[torch.from_numpy(rng.permutation(ROWS)[:3])] = True
        if ended.any():
            seen["reset"] += int(ended.sum())
            world.reset(options={"reset_mask": ended})
    # Without these the comparison above would prove nothing.
    assert seen["rows"] > 0.95 * ROWS * STEPS
    assert min(seen["success"], seen["reset"]) >= 5, seen
    assert seen["failure"] >= 5 if name in FAILING else seen["failure"] == 0, seen
    assert seen["success"] < 0.5 * seen["rows"]


@pytest.mark.parametrize("scale", [0.1, 10.0])
def test_the_suites_factor_scales_the_returned_reward_alone(scale: float) -> None:
    world = world_of("TwoCatchUnderarm", True, 3, reward_scale=scale)
    world.reset(seed=2)
    lens = Lens(scene_of(world).model)
    for _ in range(3):
        _, reward, *_, info = world.step(torch.zeros(3, 52))
        told = judgements(world, "TwoCatchUnderarm", lens)
        compare(np.ones(3, dtype=bool), told, reward.numpy(), info, scale)


def test_rewards_of_a_mixed_world() -> None:
    """Each slot of a mixed group is judged by its own formula; terms a class has not are zero in its rows."""
    world = mixed_world(2)
    generator = torch.Generator().manual_seed(8)
    world.reset(seed=5)
    for _ in range(4):
        action = torch.rand(world.num_envs, 52, generator=generator) * 2 - 1
        _, reward, _, _, info = world.step(action)
    for part in world.parts:
        for member in part.group.members:
            name, lens = member.scene.task.name, Lens(member.scene.model)
            rows = range(member.env_ids.start, member.env_ids.stop)
            for row, at in zip(rows, range(member.engine_rows.start, member.engine_rows.stop), strict=True):
                data = lens.look(part.group.engine.placement()[at])
                told = FORMULAS[name].judge(data, task_of(world, row))
                found = {term: float(value[row]) for term, value in info["reward_terms"].items()}
                assert {term for term, value in found.items() if value} == set(told.terms)
                assert float(reward[row]) == pytest.approx(sum(told.terms.values()), rel=1e-5, abs=1e-5)

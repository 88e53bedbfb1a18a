"""A world on mujoco_warp (Warp's CPU device) against one on C MuJoCo; its contract: tests/test_contract.py."""

import numpy as np
import pytest
import torch
from torch import Tensor

from bidex_meta.tasks import registry
from bidex_meta.world import World, WorldConfig
from tests.tasks.worlds import slot
from tests.world.play import flat, random_actions
from tests.world.test_masked import assert_steps_look_at_nothing

ROWS = 6
CLASSES = ("CatchUnderarm", "BottleCap-v2")
"""A free body between moving bases; an object with joints."""
pytestmark = [pytest.mark.timeout(900), pytest.mark.xdist_group("warp")]


def make(engine: str, task_sampling: str = "uniform") -> World:
    slots = [slot(registry.get(name)) for name in CLASSES]
    return World(slots, WorldConfig(ROWS, engine=engine, observation="one-hot", task_sampling=task_sampling, threads=1))


@pytest.fixture(scope="module")
def world() -> World:
    """Reset it before use."""
    return make("warp")


@pytest.fixture(scope="module")
def reference() -> World:
    return make("c")


def close(a: Tensor, b: Tensor, tolerance: float = 1e-5) -> bool:
    return bool((a - b).abs().max() < tolerance)


def test_a_seed_means_the_same_starts_and_tasks_as_on_c(world: World, reference: World) -> None:
    for seed in (0, 3):
        obs, expected = world.reset(seed=seed)[0], reference.reset(seed=seed)[0]
        assert close(obs, expected) and torch.equal(world.task_index, reference.task_index)
        assert torch.equal(world.episodes.elapsed, reference.episodes.elapsed)
    assert not close(world.reset(seed=4)[0], world.reset(seed=5)[0], 1e-3)


def test_new_tasks_are_the_same_as_on_c() -> None:
    worlds = [make(engine, "fresh") for engine in ("warp", "c")]
    before = np.zeros(0)
    for _ in range(3):
        (obs, _), (expected, _) = (world.reset() for world in worlds)
        assert close(obs, expected)
        pools = [world.pools for world in worlds]
        assert all((one == other).all() for one, other in zip(*pools, strict=True))
        for world in worlds:
            world.step(torch.zeros(world.action_space.shape))
        assert not np.isin(pools[0][1], before).any()
        before = pools[0][1]


def test_rows_that_end_start_anew_where_c_does(world: World, reference: World) -> None:
    world.reset(seed=2)
    reference.reset(seed=2)
    ended = torch.zeros(ROWS, dtype=torch.bool)
    for action in random_actions(world, 80):
        found, wanted = flat(world.step(action)), flat(reference.step(action))
        assert found.keys() == wanted.keys()
        if not ended.any():
            assert close(found["reward"], wanted["reward"], 1e-2)
        if not torch.equal(found["info/_final_obs"], wanted["info/_final_obs"]):
            break  # an egg fell a step earlier in single precision
        now = found["info/_final_obs"]
        ended |= now
        assert close(found["obs"][now], wanted["obs"][now]) if now.any() else True
        assert torch.equal(found["obs"][~now], found["info/final_obs"][~now])
        if ended[:3].sum() >= 2:
            break
    assert ended[:3].any(), "an egg was dropped"


def test_a_step_looks_at_no_number(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    assert_steps_look_at_nothing(world, monkeypatch)

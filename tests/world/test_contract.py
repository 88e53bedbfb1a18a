from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from torch import Tensor

from bidex_meta.errors import BidexError
from bidex_meta.world import World
from tests.world.play import assert_same, flat, play, random_actions, suite_world

ROWS = 10


@pytest.fixture(scope="module")
def world() -> World:
    """Reset it before use."""
    return suite_world("MT4", ROWS)


@pytest.fixture(scope="module")
def evaluation_world() -> World:
    return suite_world("MT4", ROWS, "DISABLED")


def test_is_a_gymnasium_vector_env(world: World) -> None:
    assert isinstance(world, VectorEnv)
    assert world.unwrapped is world
    assert (world.num_envs, world.num_tasks, world.device) == (ROWS, 4, torch.device("cpu"))
    assert world.metadata["autoreset_mode"] is world.autoreset_mode is AutoresetMode.SAME_STEP
    assert world.metadata["render_modes"] == ["rgb_array"]
    single, batched = world.single_observation_space, world.observation_space
    assert isinstance(single, gymnasium.spaces.Box) and single.shape == (450,) and single.dtype == np.float32
    assert batched.shape == (ROWS, 450)
    assert world.single_action_space == gymnasium.spaces.Box(-1.0, 1.0, (52,), np.float32)
    assert world.action_space.shape == (ROWS, 52)


def test_entries_are_clipped_to_five(world: World) -> None:
    world.reset(seed=0)
    biggest = max(float(step["info/final_obs"].abs().max()) for step in play(world, random_actions(world, 30)))
    assert biggest == 5.0


def test_reward_terms_sum_to_the_reward(world: World) -> None:
    world.reset(seed=1)
    for action in random_actions(world, 30):
        _, reward, *_, info = world.step(action)
        assert torch.allclose(
            torch.stack([*info["reward_terms"].values()]).sum(dim=0), info["reward_unscaled"], atol=1e-6
        )
        assert torch.equal(reward, info["reward_unscaled"])  # the suite's scale is 1


def test_reward_scale_changes_the_reward_alone() -> None:
    plain = suite_world("MT4", 4)
    slots = [type(s)(s.name, s.task_class, s.tasks, 0.25) for s in plain.slots]
    scaled = World(slots, 4, observation="one-hot", task_sampling="uniform", threads=1)
    plain.reset(seed=0)
    scaled.reset(seed=0)
    for action in random_actions(plain, 20):
        a, b = flat(plain.step(action)), flat(scaled.step(action))
        assert torch.equal(a["reward"] * 0.25, b["reward"])
        assert torch.equal(a["info/reward_unscaled"], b["info/reward_unscaled"])
        assert torch.equal(a["obs"], b["obs"])


def test_numpy_and_lists_of_actions_are_taken(world: World) -> None:
    action = random_actions(world, 1)[0]
    results = []
    for given in (action, action.numpy(), action.double().numpy(), action.tolist()):
        world.reset(seed=0)
        results.append([flat(world.step(given))])  # type: ignore[arg-type]
        assert isinstance(results[-1][0]["obs"], Tensor)
    for other in results[1:]:
        assert_same(results[0], other)
    world.reset(seed=0)
    assert world.step(world.action_space.sample())[0].shape == (ROWS, 450)


def test_step_needs_a_reset() -> None:
    fresh = suite_world("MT4", 4)
    with pytest.raises(BidexError, match=r"reset\(\) before step\(\)"):
        fresh.step(torch.zeros(4, 52))


@pytest.mark.parametrize("mode", ["SAME_STEP", "same_step", "Same-Step", AutoresetMode.SAME_STEP, "SameStep"])
def test_training_modes(mode: Any) -> None:
    assert suite_world("MT4", 4, mode).autoreset_mode is AutoresetMode.SAME_STEP


@pytest.mark.parametrize("mode", ["DISABLED", "disabled", AutoresetMode.DISABLED])
def test_evaluation_modes(mode: Any) -> None:
    made = suite_world("MT4", 4, mode)
    assert made.metadata["autoreset_mode"] is AutoresetMode.DISABLED


@pytest.mark.parametrize("mode", ["NEXT_STEP", "same", AutoresetMode.NEXT_STEP])
def test_other_modes_are_refused(mode: Any) -> None:
    with pytest.raises(BidexError, match="DISABLED"):
        suite_world("MT4", 4, mode)
    with pytest.raises(BidexError, match="DISABLED, SAME_STEP"):
        World(suite_world("MT4", 4).slots, 4, autoreset_mode=mode)


def test_too_few_rows_name_the_minimum(world: World) -> None:
    with pytest.raises(BidexError, match="at least 4"):
        suite_world("MT4", 3)
    with pytest.raises(BidexError, match="at least 4"):
        World(world.slots, 3)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"device": "cuda"}, "device: expected one"),
        ({"task_sampling": "unifrom"}, "Unknown task_sampling"),
        ({"pad_to": 400}, "at least 446"),
    ],
)
def test_bad_options_of_a_world(world: World, bad: dict[str, Any], message: str) -> None:
    with pytest.raises(BidexError, match=message):
        World(world.slots, 4, **bad)


def test_attributes_and_calls(world: World) -> None:
    world.reset(seed=0)
    assert [int(i) for i in world.get_attr("task_index")] == world.task_index.tolist()
    assert world.get_attr("action_size") == (52,) * ROWS
    assert world.task_name == [world.task_names[i] for i in world.task_id.tolist()]
    assert world.get_attr("task_name") == tuple(world.task_name)
    assert world.call("action_size") == (52,) * ROWS
    assert len(world.call("state_dict")) == ROWS
    world.set_attr("render_mode", "none")
    assert world.render_mode == "none"
    world.set_attr("render_mode", "rgb_array")


def test_random_task_sampling_is_a_matter_of_the_suite_and_the_mode() -> None:
    assert suite_world("MT4", 4)._uniform_tasks
    assert not suite_world("MT4", 4, "DISABLED")._uniform_tasks
    assert not suite_world("ML4", 4)._uniform_tasks


def test_make_vec_gives_a_world_that_plays() -> None:
    made = gymnasium.make_vec("bidex-meta/MT4-v1", num_envs=8, device="cpu", threads=1)
    obs, _ = made.reset(seed=0)
    assert isinstance(obs, Tensor) and obs.shape == (8, 450)
    for _ in range(3):
        obs, *_, info = made.step(made.action_space.sample())
    assert obs.shape == (8, 450) and info["success"].shape == (8,)
    made.close()

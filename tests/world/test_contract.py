import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, VectorEnv

from bidex_meta.errors import BidexError
from bidex_meta.world import World
from tests.world.play import play, random_actions, suite_world

ROWS = 10


@pytest.fixture(scope="module")
def world() -> World:
    """Reset it before use."""
    return suite_world("MT4", ROWS)


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


@pytest.mark.parametrize(
    "mode", ["SAME_STEP", "same_step", "Same-Step", "SameStep", "DISABLED", "disabled", "NEXT_STEP"]
)
def test_modes_in_any_spelling(mode: str) -> None:
    name = "DISABLED" if mode.upper() == "DISABLED" else "SAME_STEP"
    if mode == "NEXT_STEP":
        for given in (mode, AutoresetMode.NEXT_STEP):
            with pytest.raises(BidexError, match="DISABLED, SAME_STEP"):
                World(suite_world("MT4", 4).slots, 4, autoreset_mode=given)
        return
    for given in (mode, AutoresetMode[name]):
        assert suite_world("MT4", 4, given).metadata["autoreset_mode"] is AutoresetMode[name]

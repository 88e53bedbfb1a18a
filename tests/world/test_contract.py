import pytest
from gymnasium.vector import AutoresetMode

from bidex_meta.errors import BidexError
from bidex_meta.world import World, WorldConfig
from tests.world.play import play, random_actions, suite_world

ROWS = 10


@pytest.fixture(scope="module")
def world() -> World:
    """Reset it before use."""
    return suite_world("MT4", ROWS)


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


def test_modes_in_any_spelling(world: World) -> None:
    spellings = {
        "SAME_STEP": ("same_step", "Same-Step", "SameStep"),
        "DISABLED": ("disabled",),
        "NEXT_STEP": ("next-step",),
    }
    for name, modes in spellings.items():
        for mode in (*modes, AutoresetMode[name]):
            made = World(world.slots, WorldConfig(4, autoreset_mode=mode, threads=1))
            assert made.metadata["autoreset_mode"] is AutoresetMode[name]
    with pytest.raises(BidexError, match="DISABLED, NEXT_STEP, SAME_STEP"):
        World(world.slots, WorldConfig(4, autoreset_mode="LAST_STEP"))

import pytest
import torch

from bidex_meta.world import World
from tests.world.play import play, random_actions, suite_world

ROWS = 12


@pytest.fixture(scope="module")
def world() -> World:
    """Reset it before use."""
    return suite_world("MT4", ROWS, "DISABLED")


def test_each_row_ends_once_and_counts(world: World) -> None:
    world.reset(seed=0)
    steps = play(world, random_actions(world, 160))
    assert torch.stack([s["info/_final_obs"] for s in steps]).sum(dim=0).tolist() == [1] * ROWS
    assert torch.stack([s["info/counted"] for s in steps]).sum(dim=0).tolist() == [1] * ROWS
    lengths = torch.stack([s["info/_final_obs"] for s in steps]).int().argmax(dim=0) + 1
    assert torch.equal(steps[-1]["info/so_far/l"], lengths)
    late = steps[-1]["truncated"]
    assert torch.equal(lengths[late], world.max_episode_steps[late])
    assert (lengths[~late] <= world.max_episode_steps[~late]).all()


def test_masked_rows_go_through_the_same_episodes_as_all(world: World) -> None:
    world.reset(seed=0)
    everything = [world.reset()[0], world.reset()[0]]
    world.reset(seed=0)
    for number in range(2):
        found = torch.zeros_like(everything[0])
        for part in range(3):
            mask = torch.arange(ROWS) % 3 == part
            found[mask] = world.reset(options={"reset_mask": mask})[0][mask]
        assert torch.equal(found, everything[number])

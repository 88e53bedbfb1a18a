import numpy as np
import torch

from bidex_meta.world import World
from tests.world.play import suite_world

SPACE = {"CatchUnderarm": 5, "HandOver": 5, "CatchAbreast": 5, "TwoCatchUnderarm": 8}


def pool(world: World, name: str, count: int, seed: int = 0) -> np.ndarray:
    slot = world.slots[world.task_names.index(name)]
    return slot.task_class.variation_space.sample(np.random.default_rng(seed), count)


def shown_goals(world: World, obs: torch.Tensor, slot: int) -> torch.Tensor:
    layout = world.slots[slot].task_class.layout
    goal = next(block.name for block, _ in layout if block.goal)
    start = layout.range(goal).start
    return obs[world.slot_env_ids[slot], start : start + 3]


def test_rows_play_the_given_tasks() -> None:
    world = suite_world("MT4", 16, "DISABLED")
    before, _ = world.reset(seed=0)
    tasks = {"CatchUnderarm": pool(world, "CatchUnderarm", 3), "TwoCatchUnderarm": pool(world, "TwoCatchUnderarm", 7)}
    world.set_tasks(tasks)
    assert world.num_slot_tasks == [3, 50, 50, 7]
    obs, _ = world.reset()
    assert world.task_index.tolist() == [0, 1, 2, 0, *range(4), *range(4), *range(4)]
    for _ in range(2):
        for name, given in tasks.items():
            slot = world.task_names.index(name)
            expected = torch.as_tensor(given)[world.task_index[world.slot_env_ids[slot]], :3].float()
            assert torch.equal(shown_goals(world, obs, slot), expected)
        assert torch.equal(shown_goals(world, obs, 1), shown_goals(world, before, 1))
        obs = world.step(torch.zeros(16, 52))[0]


def test_episodes_draw_among_the_new_tasks() -> None:
    world = suite_world("MT4", 32)
    world.reset(seed=0)
    world.set_tasks({name: pool(world, name, 2) for name in SPACE})
    world.reset()
    seen = set()
    for _ in range(6):
        world.episodes.elapsed = world.max_episode_steps - 1
        world.step(torch.zeros(32, 52))
        seen |= set(world.task_index.tolist())
    assert seen == {0, 1}

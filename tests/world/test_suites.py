import numpy as np
import pytest
import torch
from torch import Tensor

from bidex_meta.tasks import registry
from bidex_meta.world import World
from bidex_meta.world.contract import ObservationGroup
from bidex_meta.world.observations import observation_groups
from tests.world.play import class_world, play, random_actions, suite_world


@pytest.mark.parametrize(
    ("suite", "split", "classes", "width"),
    [("MT1", "train", 4, 426), ("MT4", "train", 4, 450), ("ML1", "train", 1, 422), ("ML1", "test", 1, 422),
     ("ML4", "train", 3, 446), ("ML4", "test", 1, 446), ("MT20", "train", 20, 466), ("ML20", "train", 15, 446),
     ("ML20", "test", 5, 446)],
)  # fmt: skip
def test_widths_one_hots_and_padding(suite: str, split: str, classes: int, width: int) -> None:
    world = suite_world(suite, max(classes, 9), split=split)
    obs, _ = world.reset(seed=0)
    assert obs.shape == (world.num_envs, width) and world.task_id.unique().tolist() == list(range(classes))
    assert world.single_action_space.shape == (52,)
    steps = play(world, random_actions(world, 40 if classes < 5 else 5))
    for values in [obs] + [step[name] for step in steps for name in ("obs", "info/final_obs")]:
        if suite.startswith("MT"):
            assert torch.equal(values[:, -classes:], torch.eye(classes)[world.task_id])
        padded = width - world.num_id_columns
        for slot, rows in zip(world.slots, world.slot_env_ids, strict=True):
            assert (values[rows, slot.task_class.observation_size : padded] == 0).all()
        assert values.isfinite().all() and values[:, :398].abs().sum(dim=1).min() > 1
    assert (steps[-1]["obs"] != obs).any(dim=1).all()


def test_mt_draws_every_task_equally_often_on_autoreset() -> None:
    world = suite_world("MT4", 64)
    world.reset(seed=0)
    counts, same = torch.zeros(4, 50), 0
    rounds = 40
    for _ in range(rounds):
        world.episodes.elapsed = world.max_episode_steps - 1
        before = world.task_index
        _, _, terminated, truncated, _ = world.step(torch.zeros(64, 52))
        assert (terminated | truncated).all()
        counts.index_put_((world.task_id, world.task_index), torch.ones(64), accumulate=True)
        same += int((world.task_index == before).sum())
    expected = rounds * 16 / 50
    chi_square = ((counts - expected) ** 2 / expected).sum(dim=1)
    assert (chi_square < 95).all(), chi_square  # 49 degrees of freedom: 95 is the 99.99 % quantile
    assert (counts > 0).all()
    assert same < 3 * rounds * 64 / 50


def test_a_class_in_a_suite_moves_as_on_its_own() -> None:
    suite = suite_world("MT4", 12)
    suite.reset(seed=0)
    actions = random_actions(suite, 40)
    played = play(suite, actions)
    for slot, rows in enumerate(suite.slot_env_ids):
        name = suite.task_names[slot]
        alone = class_world(name, 3, moving_base=True)
        alone.reset(seed=0)
        size = alone.observation_size
        for step, action in zip(played, actions, strict=True):
            own = play(alone, [action[rows]])[0]
            for key in ("reward", "terminated", "truncated", "info/success"):
                assert torch.equal(step[key][rows], own[key]), (name, key)
            for key in ("obs", "info/final_obs"):
                assert torch.equal(step[key][rows, :size], own[key]), (name, key)


@pytest.fixture(scope="module")
def mt4() -> World:
    """Reset it before use."""
    return suite_world("MT4", 10)


def test_entries_are_clipped_to_five(mt4: World) -> None:
    mt4.reset(seed=0)
    biggest = max(float(step["info/final_obs"].abs().max()) for step in play(mt4, random_actions(mt4, 30)))
    assert biggest == 5.0


def test_attributes_and_calls(mt4: World) -> None:
    world = mt4
    world.reset(seed=0)
    assert [int(i) for i in world.get_attr("task_index")] == world.task_index.tolist()
    assert world.get_attr("action_size") == (52,) * 10
    assert world.task_name == [world.task_names[i] for i in world.task_id.tolist()]
    assert world.get_attr("task_name") == tuple(world.task_name)
    assert world.call("action_size") == (52,) * 10
    assert len(world.call("state_dict")) == 10
    world.set_attr("render_mode", "none")
    assert world.render_mode == "none"
    world.set_attr("render_mode", "rgb_array")


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


HANDS = {"right_hand": [(0, 199)], "left_hand": [(199, 398)]}


def ranges(groups: tuple[ObservationGroup, ...]) -> dict[str, list[tuple[int, int]]]:
    return {group.name: [(where.start, where.stop) for where in group.where] for group in groups}


def entries(obs: Tensor, world: World, name: str) -> Tensor:
    where = next(group.where for group in world.observation_groups if group.name == name)
    return torch.cat([obs[:, part] for part in where], 1)


def test_groups_of_suites_and_of_a_class_alone() -> None:
    shared = HANDS | {"object": [(398, 411)]}
    mt4 = shared | {"goal": [(411, 422)], "task": [(422, 446)], "task_id": [(446, 450)]}
    assert ranges(suite_world("MT4", 4).observation_groups) == mt4
    mt20 = shared | {"task": [(411, 446)], "task_id": [(446, 466)]}
    assert ranges(suite_world("MT20", 20).observation_groups) == mt20
    ml4 = shared | {"goal": [(411, 422)], "padding": [(422, 446)]}
    assert ranges(suite_world("ML4", 3).observation_groups) == ml4
    two = HANDS | {"object": [(398, 411), (422, 435)], "goal": [(411, 422), (435, 446)]}
    assert ranges(suite_world("ML4", 1, split="test").observation_groups) == two
    alone = {"right_hand": [(0, 187)], "left_hand": [(187, 374)], "object": [(374, 387)], "goal": [(387, 398)]}
    assert ranges(class_world("HandOver", 1).observation_groups) == alone


def test_a_handle_is_of_the_object_whatever_its_name() -> None:
    layout = registry.get("LiftUnderarm").layout
    where = layout.range("right_handle_position")
    found = ranges(observation_groups([layout], layout.size, 0))
    assert found["object"] == [(398, 411), (422, 428)] and where == slice(422, 425)


def test_groups_hold_what_their_names_say() -> None:
    for world, hidden in ((suite_world("ML4", 6), True), (suite_world("MT1", 6), False)):
        world.reset(seed=0)
        for action in random_actions(world, 3):
            obs = world.step(action)[0]
        assert (entries(obs, world, "goal") == 0).all() == hidden
        if hidden:
            assert (entries(obs, world, "padding") == 0).all()
        assert torch.equal(entries(obs, world, "right_hand")[:, -26:], action[:, :26])
        assert torch.equal(entries(obs, world, "left_hand")[:, -26:], action[:, 26:])
        assert (entries(obs, world, "object").abs().sum(1) > 0.5).all()

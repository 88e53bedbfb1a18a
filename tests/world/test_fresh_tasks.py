"""Tasks without number: a new one in each episode or trial, reproducible, uniform, and none that a suite lists."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from bidex_meta import Benchmark, make_task_world
from bidex_meta.errors import BidexError
from bidex_meta.world import World, WorldConfig
from tests.world.play import assert_same, number_of_ends, play, random_actions, suite_world, world_at

SUITE = "MT4-v2"
"""Three of its classes drop what they throw, so that episodes end early."""


def fresh_world(rows: int, mode: str = "SAME_STEP", suite: str = SUITE) -> World:
    return suite_world(suite, rows, mode, tasks_per_class=0)


def same_pools(pools: list[np.ndarray], others: list[np.ndarray]) -> bool:
    return all(np.array_equal(*each) for each in zip(pools, others, strict=True))


def vectors(world: World) -> list[bytes]:
    """The task of each environment."""
    return [task.tobytes() for pool in world.pools for task in pool]


def test_each_episode_has_a_new_task() -> None:
    world = fresh_world(8)
    world.reset(seed=0)
    assert world.endless and world.task_index.tolist() == [0, 1] * 4 and world.num_slot_tasks == [2] * 4
    played = set(vectors(world))
    ends = 0
    for action in random_actions(world, 80):
        before = vectors(world)
        ended = world.step(action)[-1]["_final_obs"].tolist()
        after = vectors(world)
        assert [one != other for one, other in zip(before, after, strict=True)] == ended
        ends += sum(ended)
        played.update(after)
    assert ends >= 8 and len(played) == 8 + ends


def test_a_seed_gives_the_same_tasks_whatever_the_number_of_environments() -> None:
    one, other = fresh_world(8), fresh_world(16)
    for number in range(10):  # more episodes than are drawn ahead
        for world in (one, other):
            world.reset(seed=3 if number == 0 else None)
        for few, many in zip(one.pools, other.pools, strict=True):
            np.testing.assert_array_equal(few, many[: len(few)])
    one.reset(seed=4)
    assert not np.isin(one.pools[0], other.pools[0]).any()


def test_a_saved_world_goes_on_with_the_same_tasks() -> None:
    world = fresh_world(8)
    world.reset(seed=0)
    actions = random_actions(world, 70)
    play(world, actions[:20])
    copied = copy.deepcopy(world)
    loaded = fresh_world(8)
    loaded.load_state_dict(world.state_dict())
    steps = [play(each, actions[20:]) for each in (world, copied, loaded)]
    assert number_of_ends(steps[0]) >= 8
    for other, others in ((copied, steps[1]), (loaded, steps[2])):
        assert_same(steps[0], others)
        assert same_pools(world.pools, other.pools)
    with pytest.raises(
        BidexError, match="made with the same arguments, got 1 differences: tasks without number, here none"
    ):
        suite_world(SUITE, 8).load_state_dict(world.state_dict())


@pytest.mark.parametrize("suite", [SUITE, "MT5-v2"])
def test_rewards_are_those_of_the_same_tasks_given_by_set_tasks(suite: str) -> None:
    world = fresh_world(10, suite=suite)
    world.stagger = False
    world.reset(seed=0)
    actions = random_actions(world, 6)
    play(world, actions)
    for _ in range(2):  # of later episodes too
        world.reset()
        given = world_at(world)
        given.set_tasks(dict(zip(world.task_names, world.pools, strict=True)))
        obs = given.reset()[0]
        assert torch.equal(obs, world._obs)
        mine, theirs = play(world, actions), play(given, actions)
        assert number_of_ends(mine) == 0
        assert_same(mine, theirs)


def test_hidden_values_are_those_of_the_tasks_being_played() -> None:
    world = make_task_world("BottleCap-v2", 4, "cpu", threads=1, task_sampling="fresh")
    world = World(world.slots, replace(world._config, observation="masked"))
    space = world.slots[0].task_class.variation_space
    for _ in range(2):
        world.reset()
        scaled = (world.pools[0] - space.low) / np.subtract(space.high, space.low) * 2 - 1
        np.testing.assert_allclose(world.hidden_values(), scaled, atol=1e-6)
        world.step(torch.zeros(world.action_space.shape))
        assert torch.isfinite(world.rewards_if(world.hidden_values())).all()


def test_new_tasks_are_uniform_in_their_space() -> None:
    """Kolmogorov and Smirnov: at the 1 % level the distance from the uniform distribution is below 1.63 / sqrt(n)."""
    world = make_task_world("Switch-v2", 50, "cpu", threads=1, task_sampling="fresh")
    drawn = []
    for _ in range(20):
        world.reset()
        drawn += [*world.pools[0]]
    space = world.slots[0].task_class.variation_space
    trials = [world.fresh_tasks(number, 50)[world.task_names[0]] for number in range(20)]
    for tasks in (np.stack(drawn), np.concatenate(trials)):
        assert len(np.unique(tasks, axis=0)) == len(tasks) == 1000
        shares = np.sort((tasks - space.low) / np.subtract(space.high, space.low), axis=0)
        assert shares.min() >= 0 and shares.max() < 1
        for column in shares.T:
            steps = np.arange(1001) / 1000
            assert max((steps[1:] - column).max(), (column - steps[:-1]).max()) < 1.63 / 1000**0.5
        assert abs(np.corrcoef(tasks.T)[0, 1]) < 0.1


@pytest.mark.parametrize("suite", ["MT4-v2", "ML5-v2", "ML1-SwingCup-v2"])
def test_no_new_task_is_one_of_a_suite(suite: str) -> None:
    benchmark = Benchmark(suite, tasks_per_class=0)
    world = benchmark.make_world(num_envs=5, device="cpu", threads=1, autoreset_mode="DISABLED")
    pools = [world.fresh_tasks(number, 200) for number in range(10)]
    assert all(not np.isin(pools[0][name], pools[1][name]).any() for name in world.task_names)
    drawn = {row.tobytes() for pool in pools for tasks in pool.values() for row in tasks}
    training = suite_world(suite, 100, tasks_per_class=0)
    for _ in range(10):
        training.reset()
        drawn.update(vectors(training))
    listed = [*benchmark.train_tasks, *benchmark.test_tasks, *benchmark.others.train_tasks]
    listed += Benchmark(suite).train_tasks
    assert len(drawn) >= 2900 and drawn.isdisjoint(task.data for task in listed)


def test_evaluation_and_other_splits_keep_their_number_of_tasks() -> None:
    """Evaluation on the train split plays the tasks that the suite would have trained on."""
    plain, benchmark = Benchmark("ML1-Switch-v2"), Benchmark("ML1-Switch-v2", tasks_per_class=0)
    assert benchmark.train_tasks == plain.train_tasks and benchmark.test_tasks == plain.test_tasks
    assert benchmark.others.train_tasks == plain.others.train_tasks
    made = {"num_envs": 2, "device": "cpu", "threads": 1}
    for split, mode in (("train", "DISABLED"), ("test", "DISABLED"), ("test", None), ("others", None)):
        world = benchmark.make_world(split, autoreset_mode=mode, **made)
        world.reset()
        expected = plain.make_world(split, autoreset_mode=mode, **made)
        np.testing.assert_array_equal(world.pools[0], expected.pools[0])
        assert world.endless == (split == "train")
    few = Benchmark("ML1-Switch-v2", tasks_per_class=3)
    assert few.train_tasks == plain.train_tasks[:3] and few.test_tasks == plain.test_tasks
    assert len(few.others.train_tasks) == 3


def test_given_tasks_end_the_stream_and_a_state_remembers_it() -> None:
    world = fresh_world(4)
    world.reset(seed=0)
    before = world.pools
    world.set_tasks({"CatchUnderarm": before[0][:1]})
    loaded = fresh_world(4)
    loaded.load_state_dict(world.state_dict())
    for each in (world, loaded):
        for _ in range(2):
            each.reset()
            assert same_pools(each.pools, [before[0][:1], *before[1:]])


def test_an_evaluation_world_finishes_the_episodes_of_training() -> None:
    world, evaluation = fresh_world(4), fresh_world(4, "DISABLED")
    world.reset(seed=0)
    evaluation.load_state_dict(world.state_dict())
    action = random_actions(world, 1)[0]
    assert torch.equal(world.step(action)[1], evaluation.step(action)[1])
    evaluation.reset()
    np.testing.assert_array_equal(evaluation.pools[0], world.pools[0])


@pytest.mark.parametrize(
    ("suite", "count", "message"),
    [
        ("ML1-Switch-choice2", 0, "ML1-Switch-choice2: tasks_per_class: expected classes whose tasks are drawn, got 0"),
        ("ML1-DoorOpenInward-choice4", 10, "got 10 with the listed tasks of DoorOpenInward. Leave tasks_per_class out"),
        ("MT1", 0, "MT1: tasks_per_class: .* listed tasks of CatchUnderarm"),
        ("MT4-v2", -1, "tasks_per_class: expected a whole number from 0 to 1000000, got -1"),
        ("MT4-v2", 1.5, "tasks_per_class: expected a whole number"),
    ],
)
def test_numbers_of_tasks_that_a_suite_cannot_have(suite: str, count: object, message: str) -> None:
    with pytest.raises(BidexError, match=message):
        Benchmark(suite, tasks_per_class=count)  # type: ignore[arg-type]
    with pytest.raises(BidexError, match=r"Unknown task_sampling 'fesh'\. Did you mean 'fresh'"):
        WorldConfig(task_sampling="fesh")

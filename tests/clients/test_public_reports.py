"""Bugs that users reported of other libraries, tried on our worlds and on every adapter around them.

Each docstring names the kind of library and the symptom. Reports that concern files, processes, versions and exports
without rows are tried beside what they concern: tests/runs, tests/robust, tests/metaworld and tests/cli/test_export.py.
"""

import copy
import pickle
import random
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from torch import Tensor

from bidex_meta import Benchmark
from bidex_meta.clients.gymnasium_env import TaskEnv
from bidex_meta.data.collector import EpisodeCollector
from bidex_meta.data.part_files import Episode
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.play import evaluate
from bidex_meta.metaworld import vector_envs
from bidex_meta.utils import gl_backend
from bidex_meta.world import World
from bidex_meta.world.wrapper import NumpyWorld
from tests.clients.every_client import (
    CLIENTS,
    LIMITS,
    NAME,
    ROWS,
    SINGLES,
    VECTORS,
    actions,
    client,
    numbers,
    points,
)
from tests.points import PointWorld
from tests.world.play import class_world, suite_world


def arrays(value: Any) -> list[Any]:
    """All tensors and arrays within a nest."""
    if isinstance(value, dict):
        return [each for entry in value.values() for each in arrays(entry)]
    if isinstance(value, list | tuple):
        return [each for entry in value for each in arrays(entry)]
    return [value] if isinstance(value, np.ndarray | Tensor) else []


def start(env: Any) -> np.ndarray:
    return numbers(env.reset()[0])


def start_of_agents(env: Any) -> np.ndarray:
    env.reset()
    return env.state()


# Seeds.


def test_copies_without_a_seed_are_no_copies() -> None:
    """Vector environments without a seed: all sub-environments play the same episodes.

    Gymnasium's ids: tests/clients/test_gymnasium_ids.py.
    """
    benchmark = Benchmark("MT1-v2")
    (kind,) = benchmark.train_classes.values()
    envs = [kind() for _ in range(2)]
    for env in envs:
        env.set_task(benchmark.train_tasks[0])
    assert not np.array_equal(*map(start, envs))
    if find_spec("pettingzoo"):
        make = import_module("bidex_meta.clients.pettingzoo").parallel_env
        one, two, again = (start_of_agents(make(NAME, "single", seed=seed)) for seed in (None, 2, 2))
        assert np.array_equal(two, again) and not np.array_equal(one, start_of_agents(make(NAME, "single")))


@pytest.mark.parametrize("name", CLIENTS)
def test_the_seed_of_reset_decides_whatever_was_played(name: str) -> None:
    """Metaworld #555 and #437, lerobot #3727: `reset(seed=...)` is ignored; Metaworld #385: it depends on the past."""
    one, two = client(name), client(name)
    first = one.reset(7)
    for action in actions(name, 4):
        one.step(action)
    assert np.array_equal(one.reset(7), first) and np.array_equal(two.reset(7), first)
    assert not np.array_equal(two.reset(8), first)
    one.reset(7)
    two.reset(7)
    for action in actions(name, 4):
        assert np.array_equal(one.step(action).obs, two.step(action).obs)


def test_seed_zero_is_a_seed() -> None:
    """Metaworld's custom benchmarks: `seed=0` counts as no seed."""
    for make in (
        TaskEnv,
        lambda name, seed: gymnasium.make_vec(f"bidex-meta/{name}", seed=seed, device="cpu", threads=1),
    ):
        one, two = make(NAME, seed=0), make(NAME, seed=0)
        assert np.array_equal(start(one), start(two))


@pytest.mark.parametrize("name", [name for name in CLIENTS if name not in ("rsl_rl", "skrl")])
def test_a_reset_without_a_seed_goes_on(name: str) -> None:
    """gym #250: after seeding once, every episode is the same one."""
    one = client(name)
    starts = [one.reset(3), one.reset(None), one.reset(None)]
    assert len({each.tobytes() for each in starts}) == 3
    assert all(np.array_equal(one.reset(seed), each) for seed, each in zip((3, None, None), starts, strict=True))


def test_global_generators_are_neither_read_nor_changed() -> None:
    """Metaworld #350 and #364: starts come from NumPy's global generator, and drawing tasks seeds it."""

    def states() -> list[Any]:
        return [np.random.get_state()[1].tobytes(), random.getstate(), torch.get_rng_state().numpy().tobytes()]  # type: ignore[union-attr]

    def played(seed: int) -> np.ndarray:
        np.random.seed(seed)
        random.seed(seed)
        torch.manual_seed(seed)
        before = states()
        env = TaskEnv(NAME, seed=1)
        env.reset(seed=2)
        obs = [env.step(np.full(52, 0.1, np.float32))[0]]
        world = suite_world("ML4-v2", 3, seed=4)
        world.reset()
        obs.append(numbers(world.step(torch.zeros(3, 52))[0])[0])
        assert states() == before
        return np.concatenate(obs)

    np.testing.assert_array_equal(played(0), played(1))


def test_spaces_are_seeded_one_by_one() -> None:
    """gym #3146: nobody knows what seeds an action space; environments that share one draw for each other."""
    one, two = TaskEnv(NAME), TaskEnv(NAME)
    assert one.action_space is not two.action_space
    one.action_space.seed(3)
    first = one.action_space.sample()
    one.action_space.seed(3)
    two.action_space.seed(4)
    two.action_space.sample()
    np.testing.assert_array_equal(one.action_space.sample(), first)
    assert not np.array_equal(one.action_space.sample(), first)


# Tasks and splits.


@pytest.mark.parametrize("version", ["v1", "v2"])
def test_the_id_of_a_split_gives_this_split(version: str) -> None:
    """Metaworld #573: `ML1-train` silently gives the test tasks."""
    benchmark = Benchmark("ML1" if version == "v1" else "ML1-v2")
    for split, tasks in (("train", benchmark.train_tasks), ("test", benchmark.test_tasks)):
        world: Any = gymnasium.make_vec(f"bidex-meta/ML1-{split}-{version}", num_envs=4, device="cpu", threads=1)
        pools = np.concatenate(world.unwrapped.pools)
        np.testing.assert_array_equal(pools, [task.variation for task in tasks])


def test_a_list_of_tasks_that_is_given_stays_as_it_is() -> None:
    """Metaworld's pseudo-random selection shuffles its caller's list."""
    benchmark = Benchmark("ML1-v2")
    (kind,) = benchmark.train_classes.values()
    tasks = benchmark.train_tasks
    env: Any = vector_envs.make_env(kind.recipe, tasks, seed=0, task_select="pseudorandom")
    env.get_wrapper_attr("sample_tasks")()
    env.reset()
    assert tasks == benchmark.train_tasks


def test_each_task_counts_alike_in_an_evaluation() -> None:
    """Metaworld #577: the first episodes that finish are counted, so that easy tasks crowd out hard ones."""

    class Still:
        def eval_action(self, obs: Tensor) -> Tensor:
            return torch.zeros(len(obs), 2)

        def reset(self, env_mask: Tensor) -> None: ...

    near = np.array([[0.0, 0.0], [2.0, 2.0]])  # solved at once, and never
    world = PointWorld(4, {"Both": near}, (9,), ends=True)
    found = evaluate(Still(), world, 3).classes["Both"]
    assert found.success == 0.5


# Observations.


@pytest.mark.parametrize("suite", ["MT4-v2", "MT1-objects"])
def test_observations_lie_within_their_space(suite: str) -> None:
    """Metaworld #599: goals are seen, but their bounds are zero; stable-baselines3: float64 in a float32 space."""
    world = suite_world(suite, 4)
    obs, _ = world.reset(seed=0)
    for action in np.random.default_rng(0).uniform(-1, 1, (30, 4, 52)).astype(np.float32):
        assert world.observation_space.contains(numbers(obs))
        obs, *_, info = world.step(torch.from_numpy(action))
        assert all(world.single_observation_space.contains(row) for row in numbers(info["final_obs"]))
    assert (world.single_observation_space.high > world.single_observation_space.low).all()


@pytest.mark.parametrize("suite", ["ML4-v2", "ML1"])
def test_what_is_hidden_is_in_no_observation(suite: str) -> None:
    """HPT #6 and Metaworld #393: the goal leaks into the observation, or nobody knows whether it is there."""
    worlds = [suite_world(suite, 3, "DISABLED") for _ in range(2)]
    seen = []
    worlds[1].set_tasks({name: pool[::-1] for name, pool in zip(worlds[1].task_names, worlds[1].pools, strict=True)})
    assert not np.array_equal(worlds[0].pools[0][:1], worlds[1].pools[0][:1])
    goal = next(group for group in worlds[0].observation_groups if group.name == "goal")
    for world in worlds:
        obs, _ = world.reset(seed=0)
        obs = world.step(torch.zeros(3, 52))[0]
        assert not any(obs[:, where].any() for where in goal.where)
        seen.append(obs)
    assert torch.equal(*seen)
    shown = suite_world(suite.replace("ML", "MT"), 4, "DISABLED")
    obs, _ = shown.reset(seed=0)
    goal = next(group for group in shown.observation_groups if group.name == "goal")
    assert any(obs[:, where].any() for where in goal.where)


@pytest.mark.parametrize("name", CLIENTS)
def test_what_a_step_returned_is_not_changed_by_the_next(name: str) -> None:
    """ManiSkill #828: `final_info` and observations are views of tensors that the next step writes into."""
    one = client(name)
    one.reset(0)
    kept = []
    for action in actions(name, 12):
        given = action.copy()
        raw = arrays(one.step(action).raw)
        kept.append((raw, [numbers(each).copy() for each in raw]))
        assert np.array_equal(action, given), "the action is the caller's"
    for raw, before in kept:
        for now, then in zip(raw, before, strict=True):
            if then.dtype != object:
                np.testing.assert_array_equal(numbers(now), then)


# Ends of episodes.


@pytest.mark.parametrize("name", VECTORS)
def test_a_time_limit_is_a_truncation_that_shows_the_last_observation(name: str) -> None:
    """mujoco_playground #305, IsaacLab #4369, IsaacLab-Arena #1015: it is lost, or the cut is told as an end."""
    one, twin = client(name), points("DISABLED")
    one.reset(0)
    twin.reset(seed=0)
    seen = 0
    for step in range(1, 8):
        told = one.step(np.zeros((ROWS, 2), np.float32))
        last = numbers(twin.step(torch.zeros(ROWS, 2))[0])
        late = step == np.repeat(LIMITS, 2)
        assert told.truncated.tolist() == late.tolist() and not told.terminated.any()
        seen += late.sum()
        if told.final is not None:
            np.testing.assert_array_equal(told.final[late], last[late])
        if late.any() and name != "skrl":  # which acts on the last one once more
            assert not np.array_equal(told.obs[late], last[late])
    assert seen == ROWS


@pytest.mark.parametrize("name", SINGLES)
def test_a_single_environments_time_limit_is_a_truncation(name: str) -> None:
    """PettingZoo #1126: time limits count as ends."""
    one, world = client(name), class_world(NAME, 1)
    one.reset(0)
    for step in range(1, 1 + int(world.max_episode_steps[0])):
        told = one.step(np.zeros((1, 52), np.float32))
        assert not told.terminated.any() and bool(told.truncated[0]) == (step == world.max_episode_steps[0])
    assert not np.array_equal(one.reset(None), told.obs)


@pytest.mark.parametrize("mode", ["SAME_STEP", "NEXT_STEP", "DISABLED"])
def test_lengths_of_later_episodes_are_right(mode: str) -> None:
    """Gymnasium #1017 and #1624: `RecordEpisodeStatistics` is off by one from the second episode on."""
    env = RecordEpisodeStatistics(NumpyWorld(points(mode)), buffer_length=1000)
    env.reset(seed=0)
    for _ in range(40):
        _, _, terminated, truncated, _ = env.step(np.zeros((ROWS, 2), np.float32))
        if mode == "DISABLED" and (ended := terminated | truncated).any():
            env.reset(options={"reset_mask": ended})
    expected = {5: 2 * (40 // (6 if mode == "NEXT_STEP" else 5)), 7: 2 * (40 // (8 if mode == "NEXT_STEP" else 7))}
    assert {length: list(env.length_queue).count(length) for length in set(env.length_queue)} == expected


def test_an_environment_that_is_not_reset_does_not_end_again() -> None:
    """Gymnasium's vector environments without autoreset: each further step counts as an episode."""
    env = RecordEpisodeStatistics(NumpyWorld(points("DISABLED")))
    env.reset(seed=0)
    for _ in range(40):
        env.step(np.zeros((ROWS, 2), np.float32))
    assert env.episode_count == ROWS


@pytest.mark.parametrize("name", ["world", "numpy", "sb3"])
def test_success_is_told_of_the_episode_that_had_it(name: str) -> None:
    """Autoresetting environments: `info` at an end is the next episode's, or the next one inherits the success."""
    pools = {"Here": np.array([[0.0, 0.0]]), "There": np.array([[9.0, 9.0]])}
    world = PointWorld(2, pools, (3, 3), mode="SAME_STEP", noise=0.0)
    one = VECTORS[name](world)
    one.reset(0)
    away = np.array([[0.0, 0.0], [0.0, 0.0]], np.float32)
    found = []
    for step in range(6):
        raw = one.step(away if step < 3 else np.ones((2, 2), np.float32)).raw
        if name == "sb3":
            found += [info["is_success"] for info in raw[-1] if info]
        elif "final_info" in raw[-1]:
            found += numbers(raw[-1]["final_info"]["episode"]["success"]).tolist()
    assert found == [True, False, False, False]


@pytest.mark.parametrize("mode", ["SAME_STEP", "DISABLED"])
def test_data_sets_hold_last_observations_and_why_episodes_end(mode: str) -> None:
    """Minari #146: a cut episode is refused or not marked as truncated, and its last observation is missing."""
    world, stored = points(mode), []
    recorder = EpisodeCollector(world, stored.append)
    recorder.reset(seed=0)
    lasts: dict[int, np.ndarray] = {}
    for action in actions("world", 7):
        info = recorder.step(torch.from_numpy(action))[4]
        for row in info["_final_obs"].nonzero().squeeze(1).tolist():
            lasts.setdefault(row, numbers(info["final_obs"])[row])
    firsts: list[Episode] = stored[:ROWS]
    assert sorted(episode.row for episode in firsts) == list(range(ROWS))
    for episode in firsts:
        assert len(episode.observations) == len(episode) + 1 and not episode.terminated.any()
        assert episode.truncated.tolist() == [False] * (len(episode) - 1) + [True]
        np.testing.assert_array_equal(episode.observations[-1], lasts[episode.row])


# Copies, states, pictures, the end.


def test_copies_continue_alike_and_share_nothing() -> None:
    """Metaworld #23, #38 and #426: environments cannot be copied or pickled, or a copy moves the original."""
    envs: list[Any] = [TaskEnv(NAME, seed=1), class_world(NAME, 2, "DISABLED").to_numpy()]
    steps: list[Any] = [np.full(env.action_space.shape, 0.2, np.float32) for env in envs]
    if find_spec("pettingzoo"):
        envs.append(import_module("bidex_meta.clients.pettingzoo").parallel_env(NAME, "single", seed=1))
        steps.append(dict.fromkeys(envs[-1].possible_agents, steps[0]))
    for env, action in zip(envs, steps, strict=True):
        env.reset(seed=2)
        env.step(action)
        untouched = pickle.loads(pickle.dumps(env))
        copies = copy.deepcopy(env), pickle.loads(pickle.dumps(env)), env
        told = [[arrays(each.step(action)[0])[0] for _ in range(3)] for each in (*copies, untouched)]
        assert all(np.array_equal(each, told[0]) for each in told)


def test_a_resumed_world_goes_on_with_new_episodes() -> None:
    """Learners: a resumed run repeats the episodes from the start of the run."""

    def played(world: World, steps: int) -> list[np.ndarray]:
        return [numbers(world.step(torch.zeros(2, 52))[0]) for _ in range(steps)]

    world, resumed = (class_world("CatchUnderarm", 2) for _ in range(2))
    world.stagger = False
    begun = numbers(world.reset(seed=0)[0])
    played(world, 80)
    resumed.load_state_dict(pickle.loads(pickle.dumps(world.state_dict())))
    ahead, again = played(world, 80), played(resumed, 80)
    np.testing.assert_array_equal(again, ahead)
    assert not any(np.array_equal(obs, begun) for obs in ahead)


def test_a_second_environment_leaves_the_pictures_of_the_first() -> None:
    """Metaworld #448: a second rendered environment corrupts the first; Gymnasium: `render_mode` is ignored."""
    try:
        gl_backend.prepare()
    except BidexError as error:
        pytest.skip(str(error))
    one, two = TaskEnv(NAME, "rgb_array", seed=0), TaskEnv("DoorOpenOutward-v2", "rgb_array", seed=0)
    one.reset()
    two.reset()
    first = one.render()
    assert first is not None and first.dtype == np.uint8 and first.ndim == 3
    assert not np.array_equal(two.render(), first) and np.array_equal(one.render(), first)
    two.close()
    assert np.array_equal(one.render(), first)
    one.close()
    assert TaskEnv(NAME).render() is None
    with pytest.raises(BidexError, match="'human'"):
        TaskEnv(NAME, "human")


@pytest.mark.parametrize("name", CLIENTS)
def test_closing_twice_does_no_harm(name: str) -> None:
    """Gymnasium and stable-baselines3: `close()` of a closed environment raises."""
    one = client(name)
    one.reset(0)
    one.close()
    one.close()

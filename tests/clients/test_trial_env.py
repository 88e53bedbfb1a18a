"""Trials as episodes: one environment, and a world of them."""

import warnings
from importlib import import_module
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from bidex_meta import Benchmark
from bidex_meta.clients.trial_env import TrialEnv, TrialWorld
from bidex_meta.errors import BidexError
from bidex_meta.suite_files import load_suite
from tests.world.play import random_actions

SUITE = "ML1-CatchUnderarm-v2"
ACTIONS = 52


def trial_world(num_envs: int = 3, suite: str = SUITE, episodes: int = 2, tasks: int | None = None) -> TrialWorld:
    benchmark = Benchmark(suite, tasks_per_class=tasks)
    return TrialWorld(benchmark.make_world("train", num_envs, "cpu", threads=1, episodes_per_task=episodes))


@pytest.fixture(scope="module")
def env() -> Any:
    """A trial of two episodes, by its id."""
    return gymnasium.make("bidex-meta/trials", suite=SUITE, episodes=2, seed=0)


def test_a_trial_is_one_episode_of_gymnasium(env: Any) -> None:
    with warnings.catch_warnings(action="error"):
        warnings.filterwarnings("ignore", message=".*infinity")  # of the reward's entry
        check_env(env.unwrapped, skip_render_check=True)
    obs, info = env.reset(seed=3)
    inner = env.unwrapped
    task = inner.task
    assert info == {} and not obs[-ACTIONS - 2 :].any() and obs.shape == env.observation_space.shape
    assert inner.max_episode_steps == 2 * inner._env.max_path_length
    ends = 0
    for _ in range(inner.max_episode_steps):
        action = env.action_space.sample()
        obs, reward, terminated, truncated, info = env.step(action)
        over = terminated or truncated
        assert np.array_equal(obs[-ACTIONS - 2 : -2], action) and obs[-2] == np.float32(reward)
        assert obs[-1] == ("episode_success" in info and not over) and ("is_success" in info) == over
        assert inner.task is task
        ends += "episode_success" in info
        if over:
            break
    assert over and ends == 2
    with pytest.raises(BidexError, match=r"Expected reset\(\) before step\(\)"):
        inner.step(action)


def test_each_reset_plays_another_task_and_a_seed_repeats_it(env: Any) -> None:
    first, _ = env.reset(seed=5)
    task = env.unwrapped.task
    seen = {env.reset() and env.unwrapped.task for _ in range(6)}
    assert len(seen) > 3 and seen <= set(Benchmark(SUITE).train_tasks)
    again, _ = env.reset(seed=5)
    assert np.array_equal(first, again) and env.unwrapped.task == task


def test_a_trial_env_draws_from_all_classes_and_new_tasks_where_the_suite_does() -> None:
    several = TrialEnv("ML4-v2", seed=0)
    names = {several.reset() and several.task.env_name for _ in range(12)}
    assert names == set(several._envs) and len(names) == 3
    suite = load_suite(SUITE).with_train_tasks(0)
    endless = TrialEnv(suite, seed=0)
    tasks = [endless.reset() and endless.task for _ in range(2)]
    assert tasks[0] != tasks[1] and not set(tasks) & set(Benchmark(suite).train_tasks)


def test_a_world_of_trials_keeps_a_task_for_the_trial_and_then_draws_another() -> None:
    world = trial_world(4)
    obs, _ = world.reset(seed=1)
    assert obs.shape == world.observation_space.shape and not obs[:, -ACTIONS - 2 :].any()
    tasks = [world.task_index.clone()]
    begun = torch.zeros(4, dtype=torch.int64)  # episodes that the running trial has ended
    total = torch.zeros(4)
    ended_trials = torch.zeros(4, dtype=torch.int64)
    for action in random_actions(world, int(world.max_episode_steps.max()) + 10):
        before = world.task_index.clone()
        obs, reward, terminated, truncated, info = world.step(action)
        over = terminated | truncated
        total += reward
        assert torch.equal(info["_final_obs"], over) and torch.equal(info["episode_mask"], over)
        assert torch.allclose(info["running"]["r"], total, atol=1e-5)
        assert torch.equal(before[~over], world.task_index[~over]), "the task stays within a trial"
        shown = torch.cat((action, reward[:, None]), dim=1)
        assert torch.equal(obs[~over, -ACTIONS - 2 : -1], shown[~over]) and not obs[over, -ACTIONS - 2 :].any()
        assert torch.equal(info["final_obs"][over, -ACTIONS - 2 : -1], shown[over])
        assert not info["final_obs"][over, -1].any()
        begun += obs[:, -1].long()
        assert (begun[over] == 1).all(), "one episode ended before the last one"
        if over.any():
            assert torch.equal(info["episode"]["r"][over], info["running"]["r"][over])
            tasks.append(world.task_index.clone())
        begun[over] = 0
        total[over] = 0.0
        ended_trials += over
    assert (ended_trials > 0).all() and len(torch.stack(tasks).unique()) > 4


def test_a_reset_or_broken_physics_begins_a_trial_of_another_task() -> None:
    """The rest of a trial that was left is not played as the first episodes of the next one."""
    world = trial_world(4, episodes=3)
    world.reset(seed=0)
    number = world.world.episodes
    action = torch.zeros(4, ACTIONS)
    action[1] = torch.nan
    _, _, _, truncated, info = world.step(action)
    assert truncated.tolist() == info["unstable"].tolist() == [False, True, False, False]
    assert number.number.tolist() == [0, 3, 0, 0]
    for action in random_actions(world, int(world.max_episode_steps[0])):
        world.step(action)
        if world.world.episodes.number[0] == 1:
            break
    mask = torch.tensor([True, False, False, False])
    obs, _ = world.reset(options={"reset_mask": mask})
    assert world.world.episodes.number[0] == 3 and not obs[0, -ACTIONS - 2 :].any() and obs[2:, -ACTIONS - 2 :].any()


def test_worlds_with_new_tasks_keep_theirs_for_the_trial() -> None:
    world = trial_world(2, tasks=0)
    world.reset(seed=0)
    first = world.world.pools[0].copy()
    changes = 0
    for action in random_actions(world, int(world.max_episode_steps.max()) + 5):
        _, _, terminated, truncated, _ = world.step(action)
        over = (terminated | truncated).numpy()
        assert (world.world.pools[0] == first).all(1).tolist() == (~over).tolist()
        first = world.world.pools[0].copy()
        changes += over.sum()
    assert changes >= 2


def test_numpy_and_ids_show_trials() -> None:
    options: dict[str, Any] = {"suite": SUITE, "episodes": 2, "seed": 0, "device": "cpu", "threads": 1}
    envs: Any = gymnasium.make_vec("bidex-meta/trials", num_envs=2, **options)
    size = envs.single_observation_space.shape[0]
    last = envs.observation_groups[-1]
    assert last.name == "last_step" and last.where == (slice(size - ACTIONS - 2, size),)
    own = envs.to_numpy()
    obs, _ = own.reset(seed=0)
    obs, *_ = own.step(np.full((2, ACTIONS), 0.5, np.float32))
    assert obs.shape == (2, size) and (obs[:, -ACTIONS - 2 : -2] == 0.5).all()
    singles = gymnasium.make_vec("bidex-meta/trials", num_envs=2, vectorization_mode="sync", suite=SUITE)
    assert singles.single_observation_space.shape == (size,)


def test_trials_of_one_episode_draw_tasks_too() -> None:
    world: Any = gymnasium.make_vec("bidex-meta/trials", num_envs=2, suite=SUITE, episodes=1, seed=0, device="cpu")
    tasks = [world.reset() and world.task_index for _ in range(8)]
    assert len(torch.cat(tasks).unique()) > 4
    with pytest.raises(BidexError, match=r"draws a task for each trial.* Make it with episodes_per_task"):
        TrialWorld(Benchmark(SUITE).make_world("train", 2, "cpu"))


def test_a_started_world_begins_whole_trials() -> None:
    """Its own first episodes were shortened."""
    inner = Benchmark(SUITE).make_world("train", 2, "cpu", threads=1, episodes_per_task=2)
    inner.reset(seed=0)
    world = TrialWorld(inner)
    with pytest.raises(BidexError, match=r"expected reset\(\) before step\(\)"):
        world.step(torch.zeros(2, ACTIONS))
    world.reset()
    assert not inner.episodes.elapsed.any()


def test_rsl_rl_reads_the_length_of_trials_and_cannot_shorten_them() -> None:
    world = trial_world(2)
    env = import_module("bidex_meta.clients.rsl_rl_env").RslRlVecEnv(world)
    env.reset(seed=0)
    lasted = torch.zeros(2, dtype=torch.int64)
    later = False
    for action in random_actions(world, int(world.world.max_episode_steps[0]) + 2):
        dones = env.step(action)[2]
        lasted = (lasted + 1).masked_fill(dones, 0)
        assert torch.equal(env.episode_length_buf, lasted)
        later = later or bool((lasted > world.world.episodes.elapsed).any())
    assert later, "a trial is longer than its running episode"
    with pytest.raises(BidexError, match="init_at_random_ep_len False"):
        env.episode_length_buf = torch.zeros(2)


def test_one_environment_and_a_world_show_the_same_after_broken_physics() -> None:
    env, world = TrialEnv(SUITE, episodes=2, seed=0), trial_world(1)
    env.reset()
    world.reset()
    actions = torch.full((2, ACTIONS), 0.5)
    actions[1, 0] = torch.nan
    for action in actions:
        obs, _, _, truncated, info = env.step(action.numpy())
        of_world = world.step(action[None])[-1]
    assert truncated and info["unstable"]
    # The last step's action stays the one before, which was applied. The two have different rewards.
    assert np.array_equal(obs[-ACTIONS - 2 : -2], of_world["final_obs"][0, -ACTIONS - 2 : -2]) and obs[-2] != 0.0


def test_an_episode_whose_physics_breaks_is_no_success(monkeypatch: pytest.MonkeyPatch) -> None:
    env = TrialEnv("ML1", episodes=1, seed=0)
    env.reset()
    single = env._env
    step = single.step
    told = {"success": 1.0, "unscaled_reward": 0.0, "unstable": False}
    monkeypatch.setattr(single, "step", lambda action: (*step(action)[:4], dict(told)))
    action = np.zeros(ACTIONS, np.float32)
    env.step(action)
    told["unstable"] = True
    action[0] = np.nan
    *_, info = env.step(action)
    assert info["episode_success"] is False and info["is_success"] is False


def test_what_is_no_trial_is_refused() -> None:
    for make in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(BidexError, match='Name one: suite="ML1-v2"'):
            make("bidex-meta/trials")
    with pytest.raises(BidexError, match=r"Expected a suite that hides its goals.* MT4-v2 shows them"):
        TrialEnv("MT4-v2")
    with pytest.raises(BidexError, match="split"):
        TrialEnv(SUITE, "others")
    for suite, fault, options in (
        ("MT4-v2", "hides its goals", {}),
        (SUITE, "stagger", {"stagger": True}),
        (SUITE, "vector_strategy", {"vector_strategy": "sync"}),
    ):
        with pytest.raises(BidexError, match=fault):
            gymnasium.make_vec("bidex-meta/trials", num_envs=1, suite=suite, **options)
    with pytest.raises(BidexError, match="episodes"):
        TrialEnv(SUITE, episodes=0)
    with pytest.raises(BidexError, match="Expected a suite that hides its goals"):
        TrialWorld(Benchmark("MT4-v2").make_world(num_envs=4, device="cpu", episodes_per_task=2))
    with pytest.raises(BidexError, match="SAME_STEP"):
        TrialWorld(Benchmark(SUITE).make_world(num_envs=4, device="cpu", autoreset_mode="NEXT_STEP"))
    with pytest.raises(BidexError, match=r"episodes_per_task: expected 1, because environments .* keep their tasks"):
        Benchmark(SUITE).make_world(num_envs=4, device="cpu", autoreset_mode="DISABLED", episodes_per_task=3)
    with pytest.raises(BidexError, match="episodes_per_task"):
        Benchmark(SUITE).make_world(num_envs=4, device="cpu", episodes_per_task=0)

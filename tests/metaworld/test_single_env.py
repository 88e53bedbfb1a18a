"""Single environments of a suite's classes, as code for Meta-World uses them."""

import copy
import pickle
from pathlib import Path

import cloudpickle
import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils import seeding
from gymnasium.utils.env_checker import check_env

import bidex_meta.metaworld as ours
from bidex_meta import Benchmark
from bidex_meta.errors import BidexError
from bidex_meta.world.single_env import SuiteEnv


def test_an_environment_plays_what_a_row_of_the_world_plays() -> None:
    benchmark, seed = Benchmark("MT20", 3), 5
    drawn = int(seeding.np_random(seed)[0].integers(2**31))
    classes = list(benchmark.train_classes.items())
    world = benchmark.make_world(num_envs=len(classes), device="cpu", autoreset_mode="DISABLED", threads=1)
    world_obs, _ = world.reset(seed=drawn)
    envs = []
    for i, (name, env_cls) in enumerate(classes):
        env = env_cls()
        env.set_task(next(task for task in benchmark.train_tasks if task.env_name == name))
        obs, _ = env.reset(seed=seed)
        np.testing.assert_array_equal(obs, world_obs[i, : len(obs)].numpy(), err_msg=name)
        envs.append(env)
    generator = torch.Generator().manual_seed(0)
    for _ in range(4):
        actions = 2.0 * torch.rand(len(envs), 52, generator=generator) - 1.0
        world_obs, reward, terminated, truncated, info = world.step(actions)
        for i, env in enumerate(envs):
            if env._over:
                continue
            obs, *rest, told = env.step(actions[i].numpy())
            np.testing.assert_array_equal(obs, world_obs[i, : len(obs)].numpy(), err_msg=env.task_name)
            assert rest == [float(reward[i]), bool(terminated[i]), bool(truncated[i])]
            assert told["success"] == float(info["success"][i])
            assert told["unscaled_reward"] == float(info["reward_unscaled"][i])


def test_an_environment_ends_as_its_class_says_and_at_success_if_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    mt1 = ours.MT1("CatchUnderarm", 0)
    env = mt1.train_classes["CatchUnderarm"]()
    env.set_task(mt1.train_tasks[0])
    env.toggle_terminate_on_success(True)
    for _ in range(2):
        env.reset(seed=0)
        terminated = False
        while not terminated:  # it falls long before the time is up
            _, _, terminated, truncated, info = env.step(np.full(52, -1.0, np.float32))
            assert not truncated
        assert info["success"] == 0.0
    env.reset(seed=0)
    monkeypatch.setattr(type(env.task_class), "success", lambda self, state: torch.ones(1, dtype=torch.bool))
    assert env.step(np.zeros(52, np.float32))[2:4] == (True, False)
    env.toggle_terminate_on_success(False)
    env.reset(seed=0)
    assert env.step(np.zeros(52, np.float32))[2:4] == (False, False)


@pytest.mark.parametrize("terminate", [False, True])
def test_in_version_2_success_counts_at_the_end_alone(monkeypatch: pytest.MonkeyPatch, terminate: bool) -> None:
    benchmark = Benchmark("MT1-v2", 0)
    env = benchmark.train_classes["CatchUnderarm"]()
    env.set_task(benchmark.train_tasks[0])
    env.toggle_terminate_on_success(terminate)
    solved, limit = [False], env.max_path_length
    monkeypatch.setattr(type(env.task_class), "success", lambda self, state: torch.tensor(solved))
    monkeypatch.setattr(type(env.task_class), "failed", lambda self, state: torch.zeros(1, dtype=torch.bool))
    for held, expected in ((range(20), 0.0), (range(limit - 15, limit), 1.0)):
        env.reset(seed=0)
        told = []
        for step in range(limit):
            solved[0] = step in held
            _, _, terminated, truncated, info = env.step(np.zeros(52, np.float32))
            told.append(info["success"])
            assert (terminated or truncated) == (step == limit - 1)
        assert told == [0.0] * (limit - 1) + [expected]


def test_seeds_repeat_an_episode_and_tasks_hold_from_the_next_reset() -> None:
    ml1 = ours.ML1("HandOver", 0)
    env = ml1.train_classes["HandOver"]()
    with pytest.raises(BidexError, match="set_task"):
        env.reset()
    env.set_task(ml1.train_tasks[0])
    first, again, other = (env.reset(seed=seed)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other) and not np.array_equal(env.reset()[0], env.reset()[0])
    env.set_task(ml1.train_tasks[1])
    env.step(np.zeros(52, np.float32))
    assert env._task == ml1.train_tasks[0]
    env.reset()
    assert env._task == ml1.train_tasks[1]
    assert env.seed(1) == [1]
    env.set_task(ml1.train_tasks[0])
    np.testing.assert_array_equal(env.reset()[0], first)


@pytest.mark.filterwarnings("ignore:.*infinity")
def test_an_environment_passes_gymnasiums_checker() -> None:
    env = ours.MT1("Switch").train_classes["Switch"]()
    env.set_task(ours.MT1("Switch").train_tasks[0])
    check_env(env, skip_render_check=True)


def test_classes_are_the_same_objects_and_travel() -> None:
    env_cls = Benchmark("MT4").train_classes["HandOver"]
    assert env_cls is Benchmark("MT4", 1).train_classes["HandOver"]
    assert env_cls is not Benchmark("ML4").train_classes["HandOver"]
    assert (env_cls.__name__, env_cls.task_class.name) == ("HandOver", "HandOver")
    assert pickle.loads(pickle.dumps(env_cls.recipe)).make_class() is env_cls
    assert pickle.loads(pickle.dumps(env_cls)) is copy.deepcopy(env_cls) is env_cls
    assert pickle.loads(pickle.dumps(SuiteEnv)) is SuiteEnv
    assert cloudpickle.loads(cloudpickle.dumps(env_cls))().task_name == "HandOver"
    assert set(ours.ALL_V3_ENVIRONMENTS) == set(ours.MT1.ENV_NAMES)


@pytest.mark.parametrize("begun", [False, True])
def test_environments_pickle_and_go_on_alike(begun: bool) -> None:
    benchmark = ours.ML1("CatchUnderarm", seed=2)
    env = benchmark.train_classes["CatchUnderarm"]()
    env.seed(3)
    env.set_task(benchmark.train_tasks[4])
    if begun:
        env.reset()
        env.step(np.ones(52, np.float32))
    vector = ours.make_ml_envs("CatchUnderarm", seed=0)
    assert pickle.loads(pickle.dumps(vector)).num_envs == 1
    action = np.linspace(-1, 1, 52, dtype=np.float32)
    seen = []
    for each in (pickle.loads(pickle.dumps(env)), copy.deepcopy(env), env):
        obs = [] if begun else [each.reset()[0]]
        seen.append([*obs, *(each.step(action)[0] for _ in range(3)), each.reset()[0], each.step(action)[0]])
        assert type(each) is type(env) and each._task == benchmark.train_tasks[4]
    np.testing.assert_array_equal(seen[0], seen[2])
    np.testing.assert_array_equal(seen[1], seen[2])


@pytest.mark.parametrize("limit", [40, 10_000])
def test_a_shorter_time_limit_is_where_version_2_judges(monkeypatch: pytest.MonkeyPatch, limit: int) -> None:
    env: gymnasium.Env = ours.make_mt_envs("CatchUnderarm-v2", seed=0, max_episode_steps=limit)
    task_class = env.unwrapped.task_class  # type: ignore[attr-defined]
    monkeypatch.setattr(type(task_class), "success", lambda self, state: torch.ones(1, dtype=torch.bool))
    monkeypatch.setattr(type(task_class), "failed", lambda self, state: torch.zeros(1, dtype=torch.bool))
    for _ in range(2):
        env.reset()
        told = []
        truncated = False
        while not truncated:
            _, _, terminated, truncated, info = env.step(np.zeros(52, np.float32))
            told.append(info["success"])
            assert not terminated
        assert len(told) == min(limit, task_class.episode_steps) and told == [0.0] * (len(told) - 1) + [1.0]


def test_single_environments_are_randomised_as_worlds_are_in_training(tmp_path: Path) -> None:
    text = (Path("suites") / "ML4-v2.toml").read_text()
    path = tmp_path / "heavy.toml"
    path.write_text(text + "\n[randomisation]\ngravity = [0.2, 0.2]\n")
    benchmark = Benchmark(path)
    for split, classes in (("train", benchmark.train_classes), ("test", benchmark.test_classes)):
        for name, env_class in classes.items():
            env = env_class()
            env.set_task(benchmark.tasks_of(name, split)[0])
            env.reset()
            factors = {key: value.tolist() for key, value in env._world.randomised.items() if key == "gravity"}
            assert factors == ({"gravity": [pytest.approx(0.2)]} if split == "train" else {})
    assert pickle.loads(pickle.dumps(env_class)) is env_class


def test_an_action_of_another_shape_is_told_as_the_space_has_it() -> None:
    env = ours.make_mt_envs("CatchUnderarm", seed=0)
    env.reset()
    with pytest.raises(BidexError, match=r"Expected actions of shape \(52,\), got \(51,\)"):
        env.step(np.zeros(51, np.float32))

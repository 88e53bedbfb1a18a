"""Code written for Meta-World runs here by changing the import: the same functions on its module and on ours."""

import random
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import metaworld as original
import numpy as np
import pytest
import torch
from gymnasium.utils import seeding
from metaworld import evaluation as original_evaluation

import bidex_meta.metaworld as ours
from bidex_meta import Benchmark, Task
from bidex_meta.agents import Timestep
from bidex_meta.errors import BidexError
from bidex_meta.metaworld import evaluation as our_evaluation
from bidex_meta.rules import V2

BOTH = pytest.mark.parametrize(
    ("metaworld", "name"), [(original, "reach-v3"), (ours, "HandOver")], ids=["metaworld", "bidex-meta"]
)
EVALUATION: dict[ModuleType, ModuleType] = {original: original_evaluation, ours: our_evaluation}
SHORT: dict[str, Any] = {"max_episode_steps": 8}  # where a test is about the end of episodes
ITS_OWN_CODE = """
import sys
from bidex_meta import Benchmark
benchmark = Benchmark('ML4', 3)
assert 'metaworld' not in sys.modules
import {first}, metaworld, bidex_meta.metaworld
assert isinstance(benchmark, metaworld.Benchmark)
env = metaworld.make_mt_envs("reach-v3", seed=0)
env.reset()
assert env.step(env.action_space.sample())[0].shape == (39,)
"""


def endless() -> str:
    """A file of a suite whose training draws new tasks."""
    path = Path(tempfile.mkdtemp()) / "endless.toml"
    text = Path("suites/ML1-v2.toml").read_text()
    path.write_text(text.replace("tasks_per_class = 50", "tasks_per_class = 0"))
    return str(path)


# Meta-World's examples; the benchmark is an argument.


MANY = {"ML4": lambda: ours.ML4(), "ML20": lambda: ours.ML20(), "any": lambda: Benchmark("ML4", 1)}
MANY |= {"ML1": lambda: ours.ML1("Switch"), "custom": lambda: ours.CustomML(["HandOver"], ["Switch"], seed=1)}
MANY["original"] = lambda: original.CustomML(["reach-v3"], ["drawer-close-v3"], seed=1)


@pytest.mark.parametrize("name", MANY)
def test_many_tasks(name: str) -> None:
    """Its README: a benchmark with several environments."""
    ml10: Any = MANY[name]()
    for classes, tasks in ((ml10.train_classes, ml10.train_tasks), (ml10.test_classes, ml10.test_tasks)):
        envs = []
        for name, env_cls in classes.items():
            env = env_cls()
            env.set_task(random.choice([task for task in tasks if task.env_name == name]))
            envs.append(env)
        for env in envs:
            obs, _ = env.reset()
            assert obs.shape == env.observation_space.shape
            for _ in range(3):
                obs, _, _, _, info = env.step(env.action_space.sample())
            assert obs.shape == env.observation_space.shape and info["success"] in (0.0, 1.0)
            env.close()


@BOTH
def test_an_episode_to_its_end(metaworld: ModuleType, name: str) -> None:
    """Its documentation: a scripted policy until the time is up."""
    mt1 = metaworld.MT1(name, seed=1)
    env = mt1.train_classes[name](render_mode=None)
    env.set_task(mt1.train_tasks[0])
    env.reset()
    steps, done = 0, False
    while not done:
        _, _, terminated, truncated, _ = env.step(np.zeros(env.action_space.shape, np.float32))
        done, steps = terminated or truncated, steps + 1
    assert steps <= env.max_path_length
    with pytest.raises(ValueError):
        env.step(np.zeros(env.action_space.shape, np.float32))
    assert metaworld is ours or steps == 500


class Agent:
    """Both protocols of its evaluation; counts the calls."""

    def __init__(self, envs: Any) -> None:
        self.space, self.calls = envs.action_space, dict.fromkeys(("init", "step", "adapt", "reset"), 0)

    def eval_action(self, observations: np.ndarray) -> np.ndarray:
        return np.zeros(self.space.shape, np.float32)

    def adapt_action(self, observations: np.ndarray) -> tuple[np.ndarray, dict]:
        return self.eval_action(observations), {}

    def step(self, timestep: Timestep) -> None:
        assert timestep.observation.shape[:1] == timestep.reward.shape == timestep.truncated.shape
        self._called("step")

    def _called(self, name: str) -> None:
        self.calls[name] += 1

    def reset(self, mask: np.ndarray) -> None:
        self._called("reset")

    def init(self) -> None:
        self._called("init")

    def adapt(self) -> None:
        self._called("adapt")


@BOTH
def test_evaluation_of_multi_task_environments(metaworld: ModuleType, name: str) -> None:
    envs = metaworld.make_ml_envs(name, seed=1, meta_batch_size=2, vector_strategy="sync", **SHORT)
    agent = Agent(envs)
    success, mean_return, by_name, returns = EVALUATION[metaworld].evaluation(agent, envs, num_episodes=4)
    assert success == by_name[name] == 0.0 and mean_return == pytest.approx(np.mean(returns[name]))
    assert len(returns[name]) == 4 and agent.calls["reset"] == 17
    envs.close()


@BOTH
def test_evaluation_of_an_agent_that_adapts(metaworld: ModuleType, name: str) -> None:
    envs = metaworld.make_ml_envs_test(name, seed=1, meta_batch_size=2, **SHORT)
    agent = Agent(envs)
    success, _, by_name = EVALUATION[metaworld].metalearning_evaluation(
        agent, envs, num_evals=2, adaptation_steps=1, adaptation_episodes=2, evaluation_episodes=1
    )
    assert success == by_name[name] == 0.0
    assert agent.calls == {"init": 2, "step": 2 * 2 * 8, "adapt": 2, "reset": 2 * 9}
    envs.close()


@BOTH
def test_wrappers_keep_their_meaning(metaworld: ModuleType, name: str) -> None:
    plain = metaworld.make_mt_envs(name, seed=1, **SHORT)
    size, actions = plain.observation_space.shape[0], plain.action_space.shape[0]
    options = {"use_one_hot": True, "env_id": 1, "num_tasks": 3, "recurrent_info_in_obs": True}
    env = metaworld.make_mt_envs(name, seed=1, **options, reward_normalization_method="exponential", **SHORT)
    obs, _ = env.reset()
    assert obs[size : size + 3].tolist() == [0.0, 1.0, 0.0] and len(obs) == size + 3 + actions + 2
    action = np.full(actions, 0.25, np.float32)
    for _ in range(8):
        obs, _, _, truncated, info = env.step(action)
    np.testing.assert_array_equal(obs[size + 3 : -2], action)
    assert truncated and obs[-1] == 1.0 and info["episode"]["l"] == 8
    assert metaworld is original or env.observation_space.contains(obs)
    env_id, state = env.get_checkpoint()
    assert len(state["tasks"]) == 50 and isinstance(env_id, str)


@pytest.mark.parametrize("make", [ours.make_mt_envs, ours.make_ml_envs])
def test_a_checkpoint_of_their_wrappers_goes_on_alike(make: Callable[..., Any]) -> None:
    first, second = (make("CatchUnderarm" if make is ours.make_ml_envs else "MT4", seed=seed) for seed in (0, 1))
    for envs in (first, second):
        envs.reset()
        if make is ours.make_ml_envs:
            envs.call("sample_tasks")
    second.call("load_checkpoint", list(first.call("get_checkpoint")))
    for _ in range(2):
        seen = []
        for envs in (first, second):
            if make is ours.make_ml_envs:
                envs.call("sample_tasks")
            seen.append(envs.reset()[0])
        np.testing.assert_array_equal(*seen)


def test_reset_with_a_seed_fixes_the_task_too() -> None:
    envs: Any = ours.make_mt_envs("MT4", seed=0)
    first, again, other = (envs.reset(seed=seed)[0] for seed in (5, 5, 6))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any(axis=1).all()


def test_render_mode_of_make_vec_reaches_the_environments() -> None:
    envs: Any = gymnasium.make_vec("bidex-meta/MT4-v1", vector_strategy="sync", render_mode="rgb_array")
    assert envs.get_attr("render_mode") == ("rgb_array",) * 4


# What is ours.


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("kind", ["ML", "MT"])
def test_a_client_gets_the_version_that_it_names(kind: str, version: int) -> None:
    """A loop over names, classes and tasks plays what the suite's worlds play: lengths, rewards and hidden parts."""
    names = [name for name in ours.ML1.ENV_NAMES if name.endswith("-v2") == (version == 2)]
    suite = Benchmark(f"{kind}20" + "-v2" * (version == 2))
    drawn = int(seeding.np_random(5)[0].integers(2**31))
    generator = torch.Generator().manual_seed(0)
    action = 2.0 * torch.rand(4, 52, generator=generator) - 1.0
    played = 0
    for split in suite.suite.splits:
        classes = suite.train_classes if split == "train" else suite.test_classes
        world = suite.make_world(split, num_envs=len(classes), device="cpu", autoreset_mode="DISABLED", threads=1)
        envs, goals = [], {}
        for slot in world.slots:
            (name,) = [each for each in names if each.removesuffix("-v2") == slot.name]
            one: Any = getattr(ours, f"{kind}1")(name, seed=1)
            task = one.train_tasks[3]
            again: Any = getattr(ours, f"{kind}1")(task.env_name, seed=1)
            env = again.train_classes[task.env_name]()
            env.set_task(task)
            goals[slot.name] = task.variation[None]
            envs.append(env)
            assert again.train_tasks == one.train_tasks and task.env_name == name == env.task_name
            assert one.train_classes[slot.name] is type(env) and list(one.train_classes) == [name]
            assert env.recipe.hides_goal == world.hides_goals and env.task_class.hides() == slot.task_class.hides()
        world.set_tasks(goals)
        starts, _ = world.reset(seed=drawn)
        for row, env in enumerate(envs):
            obs, _ = env.reset(seed=5)
            np.testing.assert_array_equal(obs, starts[row, : len(obs)].numpy(), err_msg=env.task_name)
            assert env.max_path_length == int(world.max_episode_steps[row])
            played += 1
        for step in range(4):
            *_, terminated, truncated, info = world.step(action[step].expand(len(envs), -1))
            for row, env in enumerate(envs):
                if not env._over:
                    *_, lost, late, told = env.step(action[step].numpy())
                    assert told["unscaled_reward"] == float(info["reward_unscaled"][row])
                    assert (lost, late) == (bool(terminated[row]), bool(truncated[row]))
        for env in envs:
            env.close()
    assert played == len(names) == 20


def test_a_version_2_episode_is_as_long_as_the_suites() -> None:
    one = ours.ML1("HandOver-v2", seed=1)
    env = one.train_classes[one.train_tasks[0].env_name]()
    envs: Any = gymnasium.make_vec("bidex-meta/ML1-train-v2", env_name="HandOver", seed=1)
    assert envs.get_attr("recipe")[0] == env.recipe and envs.get_attr("tasks")[0] == one.train_tasks
    single: Any = gymnasium.make("bidex-meta/HandOver-v2").unwrapped
    for world in (Benchmark("MT4-v2").make_world(num_envs=4, device="cpu", threads=1), single.world):
        slot = next(slot for slot in world.slots if slot.name.startswith("HandOver"))
        assert slot.task_class.rules == V2 and slot.task_class.episode_steps == env.max_path_length
        assert slot.task_class.hides() == env.task_class.hides()
    assert ours.MT1("HandOver").train_classes["HandOver"]().max_path_length < env.max_path_length


@pytest.mark.parametrize("name", ["CatchUnderarm", "Switch"])
def test_tasks_of_another_version_are_refused(name: str) -> None:
    one, two = ours.ML1(name), ours.ML1(f"{name}-v2")
    for benchmark, other in ((one, two), (two, one)):
        env = next(iter(benchmark.train_classes.values()))()
        with pytest.raises(BidexError, match="of one benchmark") as error:
            env.set_task(other.train_tasks[0])
        assert "\n" not in str(error.value)
        with pytest.raises(BidexError):  # by shape or range, where a name is written by hand
            numbers = two.train_tasks[0].variation if benchmark is one else np.full(len(env.goal_space.low), 9.0)
            env.set_task(Task.from_variation(env.task_name, numbers))
    assert f"{name}-v2" not in one.train_classes and one.train_classes.get(f"{name}-v2") is None
    assert name in two.train_classes and two.train_classes.get(name) is two.train_classes[f"{name}-v2"]


@pytest.mark.parametrize("strategy", ["sync", "async"])
def test_strategies_play_alike_and_the_seed_decides(strategy: str) -> None:
    def play(vector_strategy: str, seed: int) -> list[np.ndarray]:
        keywords: dict[str, Any] = {"vector_strategy": vector_strategy, "seed": seed, "use_one_hot": True}
        envs: Any = gymnasium.make_vec("bidex-meta/MT4-v1", **keywords, **SHORT)
        obs, _ = envs.reset()
        seen = [obs.copy()]
        for _ in range(10):
            obs, *_ = envs.step(np.full(envs.action_space.shape, 0.1, np.float32))
            seen.append(obs.copy())
        envs.close()
        return seen

    expected = play("sync", 1)
    np.testing.assert_array_equal(play(strategy, 1), expected)
    assert expected[0].shape == (4, 450) and not np.array_equal(play("sync", 2)[0], expected[0])
    np.testing.assert_array_equal(expected[0][:, 446:], np.eye(4))


def test_the_seed_of_make_vec_chooses_the_tasks() -> None:
    def pools(**keywords: Any) -> list[np.ndarray]:
        world: Any = gymnasium.make_vec("bidex-meta/ML4-train-v1", num_envs=3, device="cpu", threads=1, **keywords)
        return world.unwrapped.pools

    expected = Benchmark("ML4", 4).make_world(num_envs=3, device="cpu", threads=1).pools
    for seeds in ({"seed": 4}, {"seed": 9, "benchmark_seed": 4}, {"benchmark_seed": 4}):
        assert all(map(np.array_equal, pools(**seeds), expected))
    assert not np.array_equal(pools()[0], expected[0])
    keywords: dict[str, Any] = {"vector_strategy": "sync", "meta_batch_size": 6, "seed": 4}
    envs: Any = gymnasium.make_vec("bidex-meta/ML4-train-v1", **keywords)
    tasks = envs.get_attr("tasks")
    assert [len(share) for share in tasks] == [25] * 6
    assert {task for share in tasks for task in share} == set(Benchmark("ML4", 4).train_tasks)
    envs.close()


def test_ids_of_custom_benchmarks_and_of_one_class() -> None:
    keywords: dict[str, Any] = {"vector_strategy": "sync", "seed": 1}
    envs: Any = gymnasium.make_vec("bidex-meta/custom-mt-envs", envs_list=["Switch", "HandOver"], **keywords)
    assert envs.get_attr("task_name") == ("Switch", "HandOver")
    lists = {"train_envs": ["Switch"], "test_envs": ["HandOver"]}
    hidden: Any = gymnasium.make_vec("bidex-meta/custom-ml-envs", **lists, **keywords)
    assert hidden.get_attr("task_name") == ("Switch",) and hidden.get_attr("recipe")[0].hides_goal
    split: Any = gymnasium.make_vec("bidex-meta/ML1-test-v1", env_name="Switch", meta_batch_size=5, **keywords)
    assert {task for share in split.get_attr("tasks") for task in share} == set(ours.ML1("Switch", 1).test_tasks)


@pytest.mark.parametrize("first", ["metaworld", "bidex_meta.metaworld"])
def test_a_benchmark_is_one_of_meta_worlds_whose_own_code_runs_beside_ours(first: str) -> None:
    """Meta-World 3.0.0 makes no environment on MuJoCo 4 by itself."""
    made = Benchmark("ML4"), ours.MT20(1), ours.ML1("Switch", 2)
    assert all(isinstance(one, original.Benchmark) and isinstance(one, ours.Benchmark) for one in made)
    assert not isinstance("ML4", original.Benchmark) and type(made[0]) is made[0].__class__ is Benchmark
    subprocess.run([sys.executable, "-W", "ignore", "-c", ITS_OWN_CODE.format(first=first)], check=True, timeout=300)


def test_constructors_take_what_meta_worlds_take() -> None:
    assert ours.MT1("handover", 1).train_tasks == ours.MT1("HandOver", seed=1).train_tasks
    assert len(ours.ML1("HandOver").train_tasks) == len(ours.ML1("HandOver").test_tasks) == 50
    assert ours.ML20(7).train_tasks == Benchmark("ML20", 7).train_tasks == Benchmark("ML20", seed=7).train_tasks
    assert isinstance(ours.ML4().train_tasks[0], ours.Task) and ours.Task is Task
    assert ours.MT1("HandOver").make_world(num_envs=2, device="cpu").observation_size == 422
    assert ours.OneHotWrapper is original.OneHotWrapper
    second = ours.ML1("handover-v2", 1)
    assert second.suite.version == 2 and second.train_tasks == Benchmark(second.suite, 1).train_tasks
    assert second.suite.rules == V2
    with pytest.raises(BidexError, match="one version"):
        ours.CustomML(["HandOver-v2"], ["Switch"])


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: ours.make_ml_envs("ML20", meta_batch_size=20), "a multiple of 15"),
        (lambda: ours.make_ml_envs("ML4", meta_batch_size=12), "total_tasks_per_cls=48"),
        (lambda: ours.make_ml_envs("MT4"), "make_mt_envs('MT4')"),
        (lambda: ours.make_mt_envs("ML4"), "make_ml_envs('ML4')"),
        (lambda: ours.make_mt_envs("MT4", meta_batch_size=4), "for meta suites"),
        (lambda: ours.make_mt_envs("MT5"), "Did you mean 'MT5-v2'?"),
        (lambda: ours.make_mt_envs("MT4", vector_strategy="threads"), "Known: async, sync"),
        (lambda: ours.make_mt_envs("HandOver", reward_function_version="v1"), "the suite's reward"),
        (lambda: ours.make_mt_envs("HandOver", render_mode="human"), "rgb_array"),
        (lambda: ours.CustomML(["HandOver"], ["handover"]), "HandOver in both"),
        (lambda: gymnasium.make_vec("bidex-meta/custom-ml-envs", envs_list=[]), "at least one class"),
        (lambda: gymnasium.make_vec("bidex-meta/MT4-v1", env_name="HandOver"), "make_mt_envs('HandOver')"),
        (lambda: gymnasium.make_vec("bidex-meta/ML4-train-v2", env_name="handover"), "make_ml_envs('HandOver-v2')"),
        (lambda: gymnasium.make_vec("bidex-meta/ML1-test-v1", env_name="HandOver-v2"), "ends in -v2"),
        (lambda: gymnasium.make_vec("bidex-meta/MT4-v1", vector_strategy="sync", stagger=True), "stagger"),
        (lambda: gymnasium.make_vec("bidex-meta/MT4-v1", use_one_hot=True), "need vector_strategy"),
        (lambda: ours.make_ml_envs("HandOver", total_tasks_per_cls=100), "at most 50, the tasks of HandOver, got 100"),
        (lambda: ours.make_mt_envs("HandOver", vector_strategy="sync"), "vector_strategy: expected a suite with it"),
        (lambda: ours.make_mt_envs("HandOver", one_hot=True), "Did you mean 'use_one_hot'?"),
        (lambda: ours.make_mt_envs("MT4", use_one_hot=True, num_tasks=2), "num_tasks: expected more than env_id, 2"),
        (lambda: ours.make_ml_envs(endless(), seed=0), "training draws new tasks (tasks_per_class = 0)"),
        (lambda: ours.ML4().train_classes["HandOver"]().set_task(ours.MT1("Switch").train_tasks[0]), "one of Switch"),
    ],
)
def test_what_cannot_be_had_says_so_in_a_line(call: Callable[[], object], told: str) -> None:
    with pytest.raises(BidexError) as error:
        call()
    assert told in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(("name", "told"), [("MT10", "MT4 or MT20"), ("nothing", "docs/metaworld.md")])
def test_names_that_are_not_here_say_what_is(name: str, told: str) -> None:
    with pytest.raises(AttributeError, match=told):
        getattr(ours, name)
    assert not hasattr(ours, "ALL_V3_ENVIRONMENTS_GOAL_HIDDEN")

import copy
import pickle
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import bidex_meta
from bidex_meta.clients.gymnasium_ids import register_ids, suite_ids, task_id
from bidex_meta.errors import BidexError
from bidex_meta.tasks import registry

ROOT = Path(__file__).parents[2]
SUITE_IDS = [
    "bidex-meta/MT1-v1",
    "bidex-meta/MT4-v1",
    "bidex-meta/MT20-v1",
    "bidex-meta/ML1-train-v1",
    "bidex-meta/ML1-test-v1",
    "bidex-meta/MT1-objects-v1",
    "bidex-meta/ML1-objects-train-v1",
    "bidex-meta/ML1-objects-test-v1",
    "bidex-meta/ML1-wide-train-v1",
    "bidex-meta/ML1-wide-test-v1",
    "bidex-meta/ML4-train-v1",
    "bidex-meta/ML4-test-v1",
    "bidex-meta/ML20-train-v1",
    "bidex-meta/ML20-test-v1",
]


def test_every_suite_has_its_ids() -> None:
    ids = [env_id for name in bidex_meta.suite_names() for env_id in suite_ids(bidex_meta.load_suite(name))]
    assert sorted(ids) == sorted(SUITE_IDS)


@pytest.mark.parametrize("env_id", SUITE_IDS)
def test_suite_specs_promise_no_rows_and_no_time_limit(env_id: str) -> None:
    spec = gymnasium.spec(env_id)
    assert spec.entry_point is None and isinstance(spec.vector_entry_point, str)
    assert spec.max_episode_steps is None and "num_envs" not in spec.kwargs


@pytest.mark.parametrize("name", registry.names())
def test_class_specs_have_both_entry_points(name: str) -> None:
    spec = gymnasium.spec(task_id(name))
    assert isinstance(spec.entry_point, str) and isinstance(spec.vector_entry_point, str)
    assert spec.max_episode_steps is None and "num_envs" not in spec.kwargs


def test_registering_again_changes_nothing_and_says_nothing() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        register_ids()


def test_import_is_light() -> None:
    heavy = {"torch", "mujoco", "tensorboard", "scipy", "bidex_meta.world"}
    code = f"import sys, bidex_meta; print(*{heavy} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout == "\n"


def test_public_names_are_there() -> None:
    for name in bidex_meta.__all__:
        assert getattr(bidex_meta, name) is not None
    with pytest.raises(AttributeError, match="Bench"):
        bidex_meta.Bench  # noqa: B018


@pytest.mark.parametrize("split", ["train", "test"])
def test_make_vec_gives_the_split_it_names(split: str) -> None:
    world = gymnasium.make_vec(f"bidex-meta/ML4-{split}-v1", num_envs=6, device="cpu", threads=1, benchmark_seed=2)
    classes = bidex_meta.Benchmark("ML4", seed=2)
    expected = classes.train_classes if split == "train" else classes.test_classes
    assert world.unwrapped.task_names == list(expected)  # type: ignore[attr-defined]
    assert world.num_envs == 6
    world.close()


def test_make_vec_of_a_class_takes_the_batched_world() -> None:
    world = gymnasium.make_vec("bidex-meta/HandOver-v1", num_envs=3, device="cpu", threads=1)
    obs, _ = world.reset(seed=0)
    assert isinstance(obs, torch.Tensor) and obs.shape == (3, 398)
    world.close()


@pytest.fixture(scope="module")
def env() -> gymnasium.Env:
    return gymnasium.make("bidex-meta/CatchUnderarm-v1")


def test_single_environment_passes_gymnasiums_checker(env: gymnasium.Env) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # An unbounded observation is a matter of taste; nothing else is left to warn about.
        warnings.filterwarnings("ignore", message=".*infinity")
        check_env(env.unwrapped, skip_render_check=True)


def test_single_environment_repeats_with_its_seed(env: gymnasium.Env) -> None:
    def play(seed: int) -> list[np.ndarray]:
        obs, _ = env.reset(seed=seed)
        env.action_space.seed(0)
        return [obs] + [env.step(env.action_space.sample())[0] for _ in range(3)]

    first, again, other = play(1), play(1), play(2)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first[0], other[0])


def test_single_environment_draws_a_new_task_each_episode(env: gymnasium.Env) -> None:
    env.reset(seed=0)
    tasks = set()
    for _ in range(5):
        env.reset()
        tasks.add(int(env.unwrapped.world.task_index[0]))  # type: ignore[attr-defined]
    assert len(tasks) > 1


def test_single_environment_ends_by_its_time_limit(env: gymnasium.Env) -> None:
    env.reset(seed=0)
    limit = int(env.unwrapped.world.max_episode_steps[0])  # type: ignore[attr-defined]
    action = np.zeros(env.action_space.shape or (), np.float32)
    flags = []
    while not flags or not any(flags[-1]):
        _, reward, terminated, truncated, info = env.step(action)
        assert isinstance(reward, float) and info["success"] in (True, False)
        flags.append((terminated, truncated))
    assert len(flags) == limit or flags[-1] == (True, False)


def test_single_environment_tells_gymnasiums_keys_alone(env: gymnasium.Env) -> None:
    """Nothing of the batch: wrappers add ``episode`` themselves, and what they count is what was played."""
    counted = gymnasium.wrappers.RecordEpisodeStatistics(env)
    _, info = counted.reset(seed=3)
    assert info == {}
    total, steps, success, ended = 0.0, 0, False, False
    while not ended:
        _, reward, terminated, truncated, info = counted.step(env.action_space.sample())
        total, steps, ended = total + float(reward), steps + 1, terminated or truncated
        success |= info["success"]
        assert info.keys() - {"episode", "is_success"} == {"success", "unstable", "reward_terms"}
        assert ("is_success" in info) == ("episode" in info) == ended
        assert sum(info["reward_terms"].values()) == pytest.approx(reward, abs=1e-5)
    assert info["episode"]["l"] == steps and info["episode"]["r"] == pytest.approx(total)
    assert info["is_success"] is success


def test_single_environment_refuses_options(env: gymnasium.Env) -> None:
    with pytest.raises(BidexError, match="no reset options, got typo"):
        env.unwrapped.reset(options={"typo": 1})


def test_single_environment_copies(env: gymnasium.Env) -> None:
    env.reset(seed=0)
    actions = [env.action_space.sample() for _ in range(6)]
    for action in actions[:3]:
        env.step(action)
    for other in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        twin = copy.deepcopy(env)
        for action in actions[3:]:
            a, b = twin.step(action), other.step(action)
            np.testing.assert_array_equal(a[0], b[0])
            assert a[1:] == b[1:]

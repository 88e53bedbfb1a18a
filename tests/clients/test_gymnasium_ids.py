import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import bidex_meta
from bidex_meta.clients.gymnasium_env import TaskEnv
from bidex_meta.clients.gymnasium_ids import register_ids, suite_ids, task_id
from bidex_meta.errors import BidexError
from bidex_meta.tasks import registry

SUITES = "MT1 MT4 MT20 ML1-train ML1-test MT1-objects ML1-objects-train ML1-objects-test ML1-wide-train ML1-wide-test"
SUITE_IDS = [f"bidex-meta/{name}-v1" for name in f"{SUITES} ML4-train ML4-test ML20-train ML20-test".split()]
SUITE_IDS += [f"bidex-meta/MT{n}-v2" for n in (1, 4, 5, 20)]
SUITE_IDS += [f"bidex-meta/ML{n}-{split}-v2" for n in (1, 4, 5, 20) for split in ("train", "test")]
GROUPS = ("MT2-Doors-shared", "ML2-Doors-shared-train", "ML2-Doors-shared-test")
SUITE_IDS += [f"bidex-meta/{name}-v2" for name in GROUPS]


def test_every_suite_has_its_ids() -> None:
    ids = [env_id for name in bidex_meta.suite_names() for env_id in suite_ids(bidex_meta.load_suite(name))]
    of_class = [env_id for env_id in ids if any(name in env_id for name in registry.names())]
    assert sorted(set(ids) - set(of_class)) == sorted(SUITE_IDS)
    kinds = [f"MT1-{name}-v2" for name in registry.names()]
    kinds += [f"ML1-{name}-{split}-v2" for name in registry.names() for split in ("train", "test")]
    assert {f"bidex-meta/{kind}" for kind in kinds} <= set(of_class) and len(of_class) == len(kinds) + 5 * 3 * 3


@pytest.mark.parametrize("env_id", [*SUITE_IDS, *map(task_id, registry.names())])
def test_specs_fix_no_size_and_no_time_limit(env_id: str) -> None:
    with warnings.catch_warnings(action="error"):
        register_ids()  # again
    spec = gymnasium.spec(env_id)
    assert isinstance(spec.vector_entry_point, str) and (spec.entry_point is None) == (env_id in SUITE_IDS)
    assert spec.max_episode_steps is None and "num_envs" not in spec.kwargs


def test_an_unknown_name_is_no_attribute() -> None:
    with pytest.raises(AttributeError, match="Bench"):
        bidex_meta.Bench  # noqa: B018


@pytest.fixture(scope="module")
def env() -> gymnasium.Env:
    return gymnasium.make("bidex-meta/CatchUnderarm-v1")


def test_single_environment_passes_gymnasiums_checker(env: gymnasium.Env) -> None:
    with warnings.catch_warnings(action="error"):
        warnings.filterwarnings("ignore", message=".*infinity")  # unbounded observations are a matter of taste
        check_env(env.unwrapped, skip_render_check=True)
    with pytest.raises(BidexError, match="no reset options, got typo"):
        env.unwrapped.reset(options={"typo": 1})


def test_single_environment_draws_a_new_task_each_episode(env: gymnasium.Env) -> None:
    world = env.unwrapped.world  # type: ignore[attr-defined]
    assert len({int(world.task_index[0]) for seed in (0, *[None] * 5) if env.reset(seed=seed)}) > 1


ID = "bidex-meta/CatchUnderarm-v2"


def starts(envs: gymnasium.vector.VectorEnv) -> np.ndarray:
    return np.asarray(envs.reset()[0])


def test_copies_without_a_seed_start_differently() -> None:
    envs = gymnasium.make_vec(ID, num_envs=4, vectorization_mode="sync")
    assert len(np.unique(starts(envs), axis=0)) == 4
    pools = [env.unwrapped.world.pools[0] for env in envs.envs]  # type: ignore[attr-defined]
    assert all(np.array_equal(pool, pools[0]) for pool in pools), "the tasks are the benchmark's"
    first, again = starts(envs), np.asarray(envs.reset(seed=3)[0])
    assert not np.array_equal(first, again) and np.array_equal(again, np.asarray(envs.reset(seed=3)[0]))


@pytest.mark.parametrize("env_id", [ID, "bidex-meta/MT1-v2"])
def test_worlds_of_make_vec_start_differently_unless_seeded(env_id: str) -> None:
    options: dict[str, Any] = {"num_envs": 4, "device": "cpu", "threads": 1}
    worlds: list[Any] = [gymnasium.make_vec(env_id, **options) for _ in range(2)]
    one, two = map(starts, worlds)
    assert not np.array_equal(one, two)
    assert all(map(np.array_equal, worlds[0].unwrapped.pools, worlds[1].unwrapped.pools))
    seed = worlds[0].unwrapped.seed
    assert np.array_equal(starts(gymnasium.make_vec(env_id, seed=seed, benchmark_seed=0, **options)), one)
    five, other = (starts(gymnasium.make_vec(env_id, seed=5, **options)) for _ in range(2))
    assert np.array_equal(five, other)


def test_meta_worlds_environments_start_differently_unless_seeded() -> None:
    options: dict[str, Any] = {"vector_strategy": "sync"}
    one, two = (starts(gymnasium.make_vec("bidex-meta/MT1-v2", **options)) for _ in range(2))
    assert not np.array_equal(one, two)
    one, two = (starts(gymnasium.make_vec("bidex-meta/MT1-v2", seed=2, **options)) for _ in range(2))
    assert np.array_equal(one, two)
    other = starts(gymnasium.make_vec("bidex-meta/MT1-v2", seed=3, benchmark_seed=2, **options))
    assert not np.array_equal(one, other), "`seed` decides the starts whatever `benchmark_seed` says"


def test_our_own_functions_start_alike() -> None:
    one, two = (bidex_meta.make_task_world("CatchUnderarm-v2", 4, "cpu", threads=1) for _ in range(2))
    assert torch.equal(one.reset()[0], two.reset()[0])
    other = bidex_meta.make_task_world("CatchUnderarm-v2", 4, "cpu", threads=1, seed=7, task_seed=0)
    assert np.array_equal(other.pools[0], one.pools[0]) and not torch.equal(other.reset()[0], two.reset()[0])


def test_a_single_environment_is_not_stepped_beyond_its_end() -> None:
    """Its end would be counted again."""
    env = TaskEnv("CatchUnderarm", seed=0)
    with pytest.raises(BidexError, match=r"Expected reset\(\) before step\(\)"):
        env.step(np.zeros(52, np.float32))
    env.reset()
    while not any(env.step(np.zeros(52, np.float32))[2:4]):
        pass
    with pytest.raises(BidexError, match=r"Expected reset\(\) before step\(\)"):
        env.step(np.zeros(52, np.float32))
    env.reset()
    env.step(np.zeros(52, np.float32))


def test_single_environment_info_has_gymnasiums_keys_alone(env: gymnasium.Env) -> None:
    """Nothing of the batch: wrappers add ``episode`` themselves, and count what was played."""
    counted = gymnasium.wrappers.RecordEpisodeStatistics(env)
    _, info = counted.reset(seed=3)
    assert info == {}
    total, steps, success, ended = 0.0, 0, False, False
    while not ended:
        _, reward, terminated, truncated, info = counted.step(env.action_space.sample())
        assert isinstance(reward, float)
        total, steps, ended = total + float(reward), steps + 1, terminated or truncated
        success |= info["success"]
        assert info.keys() - {"episode"} == {"success", "is_success", "unstable", "reward_terms"}
        assert ("episode" in info) == ended and info["is_success"] is success
        assert sum(info["reward_terms"].values()) == pytest.approx(reward, abs=1e-5)
    assert info["episode"]["l"] == steps and info["episode"]["r"] == pytest.approx(total)

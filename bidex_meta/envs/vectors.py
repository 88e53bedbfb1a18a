"""Single environments in Meta-World's wrappers, side by side in Gymnasium's vector environments.

What each keyword does is Meta-World's (`metaworld.make_mt_envs`, `make_ml_envs`); the wrappers are its own.
"""

import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import gymnasium
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from bidex_meta.envs.suite_env import AnyTask, EnvRecipe
from bidex_meta.errors import BidexError, known_name

VectorStrategy = Literal["sync", "async"]
_STRATEGIES = {"sync": SyncVectorEnv, "async": AsyncVectorEnv}


class Place(NamedTuple):
    """One environment of a vector: its class and the tasks it draws from."""

    recipe: EnvRecipe
    tasks: list[Any]


def make_env(
    recipe: EnvRecipe,
    tasks: Sequence[AnyTask],
    seed: int | None = None,
    max_episode_steps: int | None = None,
    terminate_on_success: bool = False,
    use_one_hot: bool = False,
    env_id: int | None = None,
    num_tasks: int | None = None,
    recurrent_info_in_obs: bool = False,
    normalize_reward_in_recurrent_info: bool = True,
    task_select: Literal["random", "pseudorandom"] = "random",
    reward_normalization_method: Literal["gymnasium", "exponential"] | None = None,
    normalize_observations: bool = False,
    reward_alpha: float = 0.001,
    **options: Any,
) -> gymnasium.Env:
    """One environment in Meta-World's wrappers: it draws its tasks itself.

    Args:
        recipe: The class, as a suite has it.
        tasks: Tasks of that class.
        seed: Of starts and task draws; None: another one each time.
        max_episode_steps: A shorter time limit.
        terminate_on_success: Whether an episode ends at its first success; `toggle_terminate_on_success` changes it.
        use_one_hot: Append the one-hot of `env_id` among `num_tasks`.
        env_id: Which of them it is.
        num_tasks: Entries of the one-hot.
        recurrent_info_in_obs: Append the last action, the last reward and whether the episode ended.
        normalize_reward_in_recurrent_info: That reward divided by 10.
        task_select: `"random"`: a task drawn at each reset; `"pseudorandom"`: round and round, at `sample_tasks()`.
        reward_normalization_method: Gymnasium's `NormalizeReward`, or Meta-World's exponential average.
        normalize_observations: Gymnasium's `NormalizeObservation`.
        reward_alpha: Of the exponential average.
        **options: Those of `SuiteEnv`.
    """
    from metaworld import wrappers

    env: Any = recipe.make_class()(**options)
    if seed is not None:
        env.seed(seed)
    env.toggle_terminate_on_success(terminate_on_success)
    if max_episode_steps is not None:
        env = gymnasium.wrappers.TimeLimit(env, max_episode_steps)
    if use_one_hot:
        if env_id is None or num_tasks is None:
            raise BidexError("use_one_hot: expected env_id and num_tasks with it, got none. Give both.")
        with warnings.catch_warnings(action="ignore"):  # its space is made of float64 bounds
            env = wrappers.OneHotWrapper(env, env_id, num_tasks)
    if recurrent_info_in_obs:
        env = wrappers.RNNBasedMetaRLWrapper(env, normalize_reward=normalize_reward_in_recurrent_info)
    if reward_normalization_method == "gymnasium":
        env = gymnasium.wrappers.NormalizeReward(env)
    elif reward_normalization_method == "exponential":
        env = wrappers.NormalizeRewardsExponential(reward_alpha=reward_alpha, env=env)
    if normalize_observations:
        env = gymnasium.wrappers.NormalizeObservation(env)
    env = gymnasium.wrappers.RecordEpisodeStatistics(env)
    select: Any = (
        wrappers.RandomTaskSelectWrapper if task_select == "random" else wrappers.PseudoRandomTaskSelectWrapper
    )
    return wrappers.CheckpointWrapper(select(env, list(tasks)), f"{recipe.name}_{env_id}")


def make_vector(
    places: Sequence[Place],
    seed: int | None = None,
    vector_strategy: str = "sync",
    autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
    **options: Any,
) -> SyncVectorEnv | AsyncVectorEnv:
    """Environments side by side: `"sync"` in this process, `"async"` in a process each.

    Args:
        places: One for each environment.
        seed: Environment i gets `seed + i`; None: another one each time.
        vector_strategy: `"sync"` or `"async"`.
        autoreset_mode: Gymnasium's; Meta-World's evaluation needs SAME_STEP.
        **options: Those of `make_env`.

    Raises:
        BidexError: Another strategy.
    """
    make = _STRATEGIES[known_name("vector_strategy", vector_strategy, _STRATEGIES)]
    makers = [
        partial(
            make_env, place.recipe, place.tasks, seed=None if seed is None else seed + i, **{"env_id": i, **options}
        )
        for i, place in enumerate(places)
    ]
    return make(makers, autoreset_mode=autoreset_mode)


def split_tasks(tasks: Sequence[Any], envs: int) -> list[list[Any]]:
    """The tasks of a class over its environments, as many for each.

    Raises:
        BidexError: They do not divide evenly.
    """
    if len(tasks) % envs:
        fitting = len(tasks) - len(tasks) % envs
        raise BidexError(
            f"meta_batch_size: expected {len(tasks)} tasks of a class to divide evenly over its {envs} environments. "
            + (f"Add total_tasks_per_cls={fitting}, or take another size." if fitting else "Take a smaller size.")
        )
    return [list(tasks[i::envs]) for i in range(envs)]

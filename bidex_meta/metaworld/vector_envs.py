"""Meta-World's functions that make environments: `make_mt_envs`, `make_ml_envs`, and the makers of its Gymnasium ids.

Each environment is wrapped in Meta-World's own wrappers, and Gymnasium's vector environments run them together.
Keywords mean the same as in Meta-World.
"""

import inspect
import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv

from bidex_meta.benchmark import Benchmark
from bidex_meta.errors import BidexError, known_name, unknown_name
from bidex_meta.metaworld.benchmarks import ML1, MT1, CustomML, CustomMT
from bidex_meta.metaworld.library import mended
from bidex_meta.rules import V1, plain_name, versioned_name
from bidex_meta.suite_files import known_suite, load_suite
from bidex_meta.tasks import registry
from bidex_meta.tasks.task import Task
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.validation import Count, Few, true_or_false
from bidex_meta.world.contract import Info, Options
from bidex_meta.world.episodes import checked_mode
from bidex_meta.world.single_env import AnyTask, EnvRecipe, SuiteEnv

Option = Any  # a keyword argument of Meta-World's functions; ``make_env`` and ``SuiteEnv`` define the types
_STRATEGIES = {"sync": SyncVectorEnv, "async": AsyncVectorEnv}
_OF_VECTORS = {"vector_strategy", "autoreset_mode", "meta_batch_size", "total_tasks_per_cls"}


@checked_arguments
def make_mt_envs(
    name: str, seed: int | None = None, num_tasks: Few | None = None, **options: Option
) -> gymnasium.Env | VectorEnv:
    """Make one environment of a class, or a vector environment with one environment per class of a suite.

    The environments show their goals and draw a task at each reset. `seed` chooses the set of tasks, the start states
    and the order in which tasks are drawn. If `seed` is None, the tasks are those of seed 0, and the rest is random.
    `num_tasks` is the size of the one-hot that `use_one_hot=True` appends, by default the number of classes. `options`
    are `vector_strategy`, `autoreset_mode` and those of `make_env`. Raises BidexError for an unknown name, or a suite
    that hides its goals.
    """
    if _is_class(name):
        if fault := sorted(_OF_VECTORS & options.keys()):
            raise BidexError(
                f"{fault[0]}: expected a suite with it, such as MT4, because {name} is one environment. Leave it out."
            )
        benchmark = MT1(name, seed)
        [(env_name, env_class)] = benchmark.train_classes.items()
        env_id = 0 if true_or_false("use_one_hot", options.get("use_one_hot", False)) else None
        given = {"num_tasks": num_tasks or 1, "env_id": env_id, **options}
        return make_env(env_class.recipe, benchmark.tasks_of(env_name), seed, **given)
    return _multi_task(Benchmark(name, seed or 0), seed, num_tasks, **options)


@checked_arguments
def make_ml_envs(
    name: str,
    seed: int | None = None,
    meta_batch_size: int | None = None,
    total_tasks_per_cls: Few | None = None,
    split: str = "train",
    **options: Option,
) -> VectorEnv:
    """Make environments of a class or meta suite with hidden goals, each with an equal share of its class's tasks.

    `meta_batch_size` is the number of environments, which are split evenly over the classes; by default each class has
    one environment. `total_tasks_per_cls` is the number of tasks of each class that its environments share, by default
    all. `seed` and `options` are as in `make_mt_envs`. Raises BidexError for an unknown name, a suite that shows its
    goals, or environments or tasks that cannot be split evenly.
    """
    if _is_class(name):
        benchmark = ML1(name, seed)
    else:
        benchmark = Benchmark(name, seed or 0)
    return _meta(benchmark, seed, meta_batch_size, total_tasks_per_cls, split, **options)


make_ml_envs_train = partial(make_ml_envs, terminate_on_success=False, task_select="pseudorandom", split="train")
make_ml_envs_test = partial(make_ml_envs, terminate_on_success=True, task_select="pseudorandom", split="test")


@checked_arguments
def make_split(
    suite: str, split: str, task_seed: int, seed: int, env_name: str | None = None, **options: Option
) -> VectorEnv:
    """Make the environments of `gymnasium.make_vec("bidex-meta/ML20-train-v1", vector_strategy=...)`.

    `task_seed` chooses the tasks. `seed` determines the start states and the order in which tasks are drawn. With the
    ids of ML1, `env_name` is the class to use, as in Meta-World; the class is taken in the version that the id has.
    Raises BidexError if `env_name` is given with another suite. `options` are those of `make_mt_envs` or
    `make_ml_envs`.
    """
    if env_name is None:
        benchmark = Benchmark(suite, task_seed)
    else:
        benchmark = _of_one_class(suite, env_name, task_seed)
    if benchmark.suite.kind == "multi-task":
        return _multi_task(benchmark, seed, **options)
    select = {"task_select": "pseudorandom", "terminate_on_success": split == "test"}
    return _meta(benchmark, seed, split=split, **(select | options))


def _of_one_class(suite: str, env_name: str, seed: int) -> Benchmark:
    """Make the benchmark ML1 of the class `env_name`, in the version (1 or 2) that `suite` has.

    Raises BidexError if `suite` is not ML1 (`"ML1"` or `"ML1-v2"`), or if it has version 1 and `env_name` names a class
    of version 2.
    """
    rules = load_suite(suite).rules
    given = registry.resolve(env_name)
    named = versioned_name(given, rules)
    if suite not in ("ML1", "ML1-v2"):
        if load_suite(suite).kind == "meta":
            make = "make_ml_envs"
        else:
            make = "make_mt_envs"
        raise BidexError(f"env_name goes with the ids of ML1, got it with {suite}. For one class: {make}({named!r}).")
    if rules == V1 and given != plain_name(given):
        raise BidexError(
            f"env_name: expected a class of version 1 for this id, got {env_name!r}. Take ML1's id that ends in -v2."
        )
    return ML1(named, seed)


@checked_arguments
def make_custom(
    seed: int | None = None,
    envs_list: Sequence[str] | None = None,
    train_envs: Sequence[str] | None = None,
    test_envs: Sequence[str] | None = None,
    num_envs: int | None = None,
    **options: Option,
) -> VectorEnv:
    """Make the environments of the ids `custom-mt-envs` (`envs_list`) and `custom-ml-envs` (`train_envs`, `test_envs`).

    Classes in `envs_list` show their goals. Classes in `train_envs` and `test_envs` hide their goals; the environments
    are made from `train_envs`, or from `test_envs` if `split="test"`. `num_envs` is ignored, as in Meta-World. Options
    are those of `make_mt_envs` or `make_ml_envs`.
    """
    if envs_list is not None:
        return _multi_task(CustomMT(envs_list, seed), seed, **options)
    if train_envs is None or test_envs is None:
        raise BidexError("Expected envs_list=[...], or train_envs=[...] and test_envs=[...], got neither.")
    return _meta(CustomML(train_envs, test_envs, seed), seed, **options)


def _multi_task(benchmark: Benchmark, seed: int | None, num_tasks: int | None = None, **options: Option) -> VectorEnv:
    if benchmark.suite.kind != "multi-task":
        raise BidexError(f"{benchmark.name} hides its goals: make_ml_envs({benchmark.name!r}) makes its environments.")
    if "meta_batch_size" in options or "total_tasks_per_cls" in options:
        raise BidexError(f"meta_batch_size and total_tasks_per_cls are for meta suites; {benchmark.name} is not one.")
    _check_numbered(benchmark)
    classes = benchmark.train_classes
    envs = [(env_class.recipe, benchmark.tasks_of(name)) for name, env_class in classes.items()]
    return _make_vector(envs, seed, num_tasks=num_tasks or len(envs), **options)


def _meta(
    benchmark: Benchmark,
    seed: int | None,
    meta_batch_size: int | None = None,
    total_tasks_per_cls: int | None = None,
    split: str = "train",
    **options: Option,
) -> VectorEnv:
    if benchmark.suite.kind != "meta":
        raise BidexError(f"{benchmark.name} shows its goals: make_mt_envs({benchmark.name!r}) makes its environments.")
    if split not in benchmark.suite.splits:
        raise BidexError(f"split: expected train or test, got {split!r}.")
    if split == "train":
        _check_numbered(benchmark)
        classes = benchmark.train_classes
    else:
        classes = benchmark.test_classes
    if meta_batch_size is None:
        size = len(classes)
    else:
        size = meta_batch_size
    if size < 1 or size % len(classes):
        fault = f"a multiple of {len(classes)}, the classes of {benchmark.name}'s {split} split"
        raise BidexError(f"meta_batch_size: expected {fault}; got {size}.")
    envs = []
    for name, env_class in classes.items():
        tasks = benchmark.tasks_of(name, split)[:total_tasks_per_cls]
        if len(tasks) < (total_tasks_per_cls or 0):
            raise BidexError(
                f"total_tasks_per_cls: expected at most {len(tasks)}, the tasks of {name}, got {total_tasks_per_cls}. "
                "Lower it, or leave it out."
            )
        envs += [(env_class.recipe, share) for share in _split_tasks(tasks, size // len(classes))]
    return _make_vector(envs, seed, **options)


def _check_numbered(benchmark: Benchmark) -> None:
    """Raise BidexError if training draws new tasks without number, because its `train_tasks` are then unseen tasks."""
    if benchmark.suite.train_tasks == 0:
        raise BidexError(
            f"{benchmark.name}: expected train tasks, but training draws new tasks (tasks_per_class = 0). Set "
            "tasks_per_class, or use Benchmark(...).make_world or TrialEnv."
        )


@checked_arguments
def make_env(
    recipe: EnvRecipe,
    tasks: Sequence[AnyTask],
    seed: int | None = None,
    max_episode_steps: Count | None = None,
    terminate_on_success: bool = False,
    use_one_hot: bool = False,
    env_id: int | None = None,
    num_tasks: Few | None = None,
    recurrent_info_in_obs: bool = False,
    normalize_reward_in_recurrent_info: bool = True,
    task_select: Literal["random", "pseudorandom"] = "random",
    reward_normalization_method: Literal["gymnasium", "exponential"] | None = None,
    normalize_observations: bool = False,
    reward_alpha: float = 0.001,
    **options: Option,
) -> gymnasium.Env:
    """Make one environment of this benchmark, wrapped in Meta-World's wrappers according to Meta-World's keywords.

    The environment plays the given `tasks`. With `task_select="random"` a task is drawn at each reset. With
    `"pseudorandom"` each call of `sample_tasks()` takes the next task of a shuffled list. `seed` determines the start
    states and the order of tasks, which are random if it is None. `max_episode_steps` shortens episodes; in version 2
    success is then judged at this limit.

    `use_one_hot` appends the one-hot of `env_id` among `num_tasks` to observations. `recurrent_info_in_obs` appends the
    last action, the last reward and whether the episode ended. The reward is divided by 10 if
    `normalize_reward_in_recurrent_info` is True. `options` are those of `SuiteEnv`.
    """
    known = inspect.signature(SuiteEnv.__init__).parameters
    for name in options.keys() - known:
        raise unknown_name("option", name, inspect.signature(make_env).parameters.keys() | known.keys() - {"self"})
    wrappers = mended().wrappers  # the package's other names do not need these wrappers
    single = recipe.make_class()(max_episode_steps=max_episode_steps, **options)
    if seed is not None:
        single.seed(seed)
    single.toggle_terminate_on_success(terminate_on_success)
    env: gymnasium.Env = single
    if use_one_hot:
        if env_id is None or num_tasks is None:
            raise BidexError("use_one_hot: expected env_id and num_tasks with it, got none. Give both.")
        if not 0 <= env_id < num_tasks:
            raise BidexError(f"num_tasks: expected more than env_id, {env_id}, got {num_tasks}. Raise num_tasks.")
        with warnings.catch_warnings(action="ignore"):  # Meta-World's space has float64 bounds
            env = wrappers.OneHotWrapper(env, env_id, num_tasks)
    if recurrent_info_in_obs:
        env = wrappers.RNNBasedMetaRLWrapper(env, normalize_reward=normalize_reward_in_recurrent_info)
    if use_one_hot or recurrent_info_in_obs:  # these two return float64
        env = gymnasium.wrappers.DtypeObservation(env, np.float32)
    if reward_normalization_method == "gymnasium":
        env = gymnasium.wrappers.NormalizeReward(env)
    elif reward_normalization_method == "exponential":
        env = wrappers.NormalizeRewardsExponential(reward_alpha=reward_alpha, env=env)
    if normalize_observations:
        env = gymnasium.wrappers.NormalizeObservation(env)
    env = gymnasium.wrappers.RecordEpisodeStatistics(env)
    select = wrappers.RandomTaskSelectWrapper if task_select == "random" else wrappers.PseudoRandomTaskSelectWrapper
    return wrappers.CheckpointWrapper(_SeedFirst(select(env, list(tasks))), f"{recipe.env_name}_{env_id}")


class _SeedFirst(gymnasium.Wrapper):
    """Seeds an environment before Meta-World's wrappers draw its task, so that ``reset(seed=...)`` fixes the task."""

    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[np.ndarray, Info]:
        if seed is not None:
            self.unwrapped.seed(seed)  # type: ignore[attr-defined]
        return super().reset(seed=seed, options=options)

    def get_checkpoint(self) -> dict:
        return self.env.get_checkpoint()  # type: ignore[attr-defined]

    def load_checkpoint(self, ckpt: dict) -> None:
        self.env.load_checkpoint(ckpt)  # type: ignore[attr-defined]


@checked_arguments
def _make_vector(
    envs: Sequence[tuple[EnvRecipe, list[Task]]],
    seed: int | None = None,
    vector_strategy: str = "sync",
    autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
    **options: Option,
) -> SyncVectorEnv | AsyncVectorEnv:
    make = _STRATEGIES[known_name("vector_strategy", vector_strategy, _STRATEGIES)]
    makers = []
    for number, (recipe, tasks) in enumerate(envs):
        own_seed = None if seed is None else seed + number
        makers.append(partial(make_env, recipe, tasks, seed=own_seed, **{"env_id": number, **options}))
    return make(makers, autoreset_mode=checked_mode(autoreset_mode))


def _split_tasks(tasks: Sequence[Task], envs: int) -> list[list[Task]]:
    """Split a class's tasks over its environments; raises BidexError if the tasks do not divide evenly."""
    if len(tasks) % envs:
        fitting = len(tasks) - len(tasks) % envs
        raise BidexError(
            f"meta_batch_size: expected {len(tasks)} tasks of a class to divide evenly over its {envs} environments. "
            + (f"Add total_tasks_per_cls={fitting}, or take another size." if fitting else "Take a smaller size.")
        )
    return [list(tasks[i::envs]) for i in range(envs)]


def _is_class(name: str) -> bool:
    """Return whether a name is a class; raises BidexError if the name is neither a class nor a suite."""
    folded = {known.casefold() for known in registry.names()}
    is_class = plain_name(name).casefold() in folded
    if not is_class and not name.endswith(".toml"):
        known_suite(name, registry.names(), "class or suite")
    return is_class

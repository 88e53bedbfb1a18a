"""Meta-World's functions that make environments: `make_mt_envs`, `make_ml_envs`, and what its Gymnasium ids take."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium
from gymnasium.vector import VectorEnv

from bidex_meta.benchmark import Benchmark
from bidex_meta.envs.vectors import Place, make_env, make_vector, split_tasks
from bidex_meta.errors import BidexError, known_name
from bidex_meta.metaworld.benchmarks import ML1, MT1, CustomML, CustomMT
from bidex_meta.suite import suite_names
from bidex_meta.tasks import registry


def make_mt_envs(
    name: str, seed: int | None = None, num_tasks: int | None = None, **options: Any
) -> gymnasium.Env | VectorEnv:
    """Environments that show their goals and draw a task at each reset.

    Args:
        name: A class, for a single environment; or a suite, for a vector with one environment of each class.
        seed: Chooses the tasks (None: 0), the starts and the task draws (None: others each time).
        num_tasks: Entries of the one-hot that `use_one_hot=True` appends; by default the number of classes.
        **options: `vector_strategy`, `autoreset_mode` and those of `bidex_meta.envs.vectors.make_env`.

    Raises:
        BidexError: Neither class nor suite, or a suite that hides its goals.
    """
    if _is_class(name):
        benchmark = MT1(name, seed)
        [(env_name, env_class)] = benchmark.train_classes.items()
        one = {"num_tasks": num_tasks or 1, "env_id": 0 if options.get("use_one_hot") else None}
        return make_env(env_class.recipe, _tasks(benchmark, "train", env_name), seed, **(one | options))
    return _multi_task(Benchmark(name, seed or 0), seed, num_tasks, **options)


def make_ml_envs(
    name: str,
    seed: int | None = None,
    meta_batch_size: int | None = None,
    total_tasks_per_cls: int | None = None,
    split: str = "train",
    **options: Any,
) -> VectorEnv:
    """Environments that hide their goals, each with an equal share of its class's tasks.

    Args:
        name: A class, or a meta suite.
        seed: Chooses the tasks (None: 0), the starts and the task draws (None: others each time).
        meta_batch_size: How many, evenly over the classes of the split; None: one of each.
        total_tasks_per_cls: How many of the tasks of each class; None: all.
        split: `"train"` or `"test"`.
        **options: `vector_strategy`, `autoreset_mode` and those of `bidex_meta.envs.vectors.make_env`.

    Raises:
        BidexError: Neither class nor suite, a suite that shows its goals, or a size that does not divide evenly.
    """
    benchmark = ML1(name, seed) if _is_class(name) else Benchmark(name, seed or 0)
    return _meta(benchmark, seed, meta_batch_size, total_tasks_per_cls, split, **options)


make_ml_envs_train = partial(make_ml_envs, terminate_on_success=False, task_select="pseudorandom", split="train")
make_ml_envs_test = partial(make_ml_envs, terminate_on_success=True, task_select="pseudorandom", split="test")


def make_split(suite: str, split: str, seed: int, env_name: str | None = None, **options: Any) -> VectorEnv:
    """What `gymnasium.make_vec("bidex-meta/ML20-train-v1", vector_strategy=...)` gives.

    Args:
        suite: The suite of the id.
        split: The split of the id.
        seed: Chooses tasks, starts and task draws.
        env_name: For the ids of ML1: this class, as in Meta-World, in place of the suite.
        **options: Those of `make_mt_envs` or `make_ml_envs`.

    Raises:
        BidexError: `env_name` with another suite.
    """
    if env_name is not None and suite != "ML1":
        raise BidexError(f"env_name goes with the ids of ML1, got it with {suite}. For one class: make_mt_envs(name).")
    benchmark = ML1(env_name, seed) if env_name is not None else Benchmark(suite, seed)
    if benchmark.suite.kind == "multi-task":
        return _multi_task(benchmark, seed, **options)
    select = {"task_select": "pseudorandom", "terminate_on_success": split == "test"}
    return _meta(benchmark, seed, split=split, **(select | options))


def make_custom(
    seed: int | None = None,
    envs_list: Sequence[str] | None = None,
    train_envs: Sequence[str] | None = None,
    test_envs: Sequence[str] | None = None,
    num_envs: int | None = None,
    **options: Any,
) -> VectorEnv:
    """What the ids `bidex-meta/custom-mt-envs` (`envs_list`) and `custom-ml-envs` (`train_envs`, `test_envs`) give.

    Args:
        seed: As in `make_mt_envs`.
        envs_list: Classes that show their goals.
        train_envs: Classes that hide them; these are played.
        test_envs: Classes that are not; `split="test"` plays them instead.
        num_envs: Ignored, as there: the other arguments say how many.
        **options: Those of `make_mt_envs` or `make_ml_envs`.
    """
    if envs_list is not None:
        return _multi_task(CustomMT(envs_list, seed), seed, **options)
    if train_envs is None or test_envs is None:
        raise BidexError("Expected envs_list=[...], or train_envs=[...] and test_envs=[...], got neither.")
    return _meta(CustomML(train_envs, test_envs, seed), seed, **options)


def _multi_task(benchmark: Benchmark, seed: int | None, num_tasks: int | None = None, **options: Any) -> VectorEnv:
    if benchmark.suite.kind != "multi-task":
        raise BidexError(f"{benchmark.name} hides its goals: make_ml_envs({benchmark.name!r}) makes its environments.")
    if "meta_batch_size" in options or "total_tasks_per_cls" in options:
        raise BidexError(f"meta_batch_size and total_tasks_per_cls are of meta suites; {benchmark.name} is none.")
    classes = benchmark.train_classes
    places = [Place(env_class.recipe, _tasks(benchmark, "train", name)) for name, env_class in classes.items()]
    return make_vector(places, seed, num_tasks=num_tasks or len(places), **options)


def _meta(
    benchmark: Benchmark,
    seed: int | None,
    meta_batch_size: int | None = None,
    total_tasks_per_cls: int | None = None,
    split: str = "train",
    **options: Any,
) -> VectorEnv:
    if benchmark.suite.kind != "meta":
        raise BidexError(f"{benchmark.name} shows its goals: make_mt_envs({benchmark.name!r}) makes its environments.")
    if split not in benchmark.suite.splits:
        raise BidexError(f"split: expected train or test, got {split!r}.")
    classes = benchmark.train_classes if split == "train" else benchmark.test_classes
    size = len(classes) if meta_batch_size is None else meta_batch_size
    if size < 1 or size % len(classes):
        raise BidexError(
            f"meta_batch_size: expected a multiple of {len(classes)}, the classes of {benchmark.name}'s {split} split; "
            f"got {size}."
        )
    places = [
        Place(env_class.recipe, share)
        for name, env_class in classes.items()
        for share in split_tasks(_tasks(benchmark, split, name)[:total_tasks_per_cls], size // len(classes))
    ]
    return make_vector(places, seed, **options)


def _tasks(benchmark: Benchmark, split: str, name: str) -> list[Any]:
    tasks = benchmark.train_tasks if split == "train" else benchmark.test_tasks
    return [task for task in tasks if task.env_name == name]


def _is_class(name: str) -> bool:
    """Whether it names a class.

    Raises:
        BidexError: It names no suite either.
    """
    folded = {known.casefold() for known in registry.names()}
    if name.casefold() not in folded and not name.endswith(".toml"):
        known_name("class or suite", name, [*registry.names(), *suite_names()])
    return name.casefold() in folded

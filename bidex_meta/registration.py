"""Gymnasium ids of every shipped suite and every task class.

Suites register a vector entry point only: a suite is a batch of different tasks. Task classes register both. Entry
points are text and their arguments plain values, so an id says the same whenever and wherever it is made.
"""

from typing import TYPE_CHECKING, Any

import gymnasium

from bidex_meta.suite import Suite, load_suite, suite_names
from bidex_meta.tasks import registry

if TYPE_CHECKING:
    from bidex_meta.world import World

NAMESPACE = "bidex-meta"


def suite_ids(suite: Suite) -> dict[str, str]:
    """The Gymnasium ids of a suite and the split each stands for, e.g. `{"bidex-meta/MT4-v1": "train"}`."""
    if suite.kind == "multi-task":
        return {f"{NAMESPACE}/{suite.name}-v{suite.version}": "train"}
    return {f"{NAMESPACE}/{suite.name}-{split}-v{suite.version}": split for split in suite.splits}


def task_id(task_name: str) -> str:
    """The Gymnasium id of a task class, e.g. `"bidex-meta/CatchUnderarm-v1"`."""
    return f"{NAMESPACE}/{task_name}-v1"


def register_ids() -> None:
    """Registers all ids; ids that are registered already stay as they are."""
    for name in suite_names():
        for env_id, split in suite_ids(load_suite(name)).items():
            if env_id not in gymnasium.registry:
                gymnasium.register(
                    env_id,
                    vector_entry_point="bidex_meta.registration:make_suite_world",
                    kwargs={"suite": name, "split": split},
                )
    for name in registry.names():
        if task_id(name) not in gymnasium.registry:
            gymnasium.register(
                task_id(name),
                entry_point="bidex_meta.clients.gymnasium_env:TaskEnv",
                vector_entry_point="bidex_meta.registration:make_class_world",
                kwargs={"task_name": name},
            )


def make_suite_world(suite: str, split: str, num_envs: int = 1, benchmark_seed: int = 0, **options: Any) -> "World":
    """What `gymnasium.make_vec("bidex-meta/MT4-v1", num_envs=...)` calls.

    Args:
        suite: Name of the suite.
        split: `"train"` or `"test"`.
        num_envs: Rows over all classes.
        benchmark_seed: Chooses the tasks.
        **options: The other keywords of `Benchmark.make_world`.
    """
    from bidex_meta.benchmark import Benchmark

    return Benchmark(suite, seed=benchmark_seed).make_world(split, num_envs=num_envs, **options)


def make_class_world(task_name: str, num_envs: int = 1, **options: Any) -> "World":
    """What `gymnasium.make_vec("bidex-meta/CatchUnderarm-v1", num_envs=...)` calls.

    Args:
        task_name: Name of the task class.
        num_envs: Rows.
        **options: The other keywords of `make_task_world`.
    """
    from bidex_meta.benchmark import make_task_world

    return make_task_world(task_name, num_envs=num_envs, **options)

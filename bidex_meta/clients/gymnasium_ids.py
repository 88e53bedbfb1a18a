"""Gymnasium ids of every shipped suite and every task class.

Suites register a vector entry point only: a suite is a batch of different tasks. Task classes register both. Entry
points are text and their arguments plain values, so an id says the same whenever and wherever it is made.
"""

from typing import TYPE_CHECKING, Any

import gymnasium

from bidex_meta.errors import BidexError, shortened
from bidex_meta.suite import Suite, load_suite, suite_names
from bidex_meta.tasks import registry

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv

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
                    vector_entry_point="bidex_meta.clients.gymnasium_ids:make_suite_world",
                    kwargs={"suite": name, "split": split},
                )
    for kind in ("mt", "ml"):
        if (env_id := f"{NAMESPACE}/custom-{kind}-envs") not in gymnasium.registry:
            gymnasium.register(env_id, vector_entry_point="bidex_meta.metaworld.vector_envs:make_custom")
    for name in registry.names():
        if task_id(name) not in gymnasium.registry:
            gymnasium.register(
                task_id(name),
                entry_point="bidex_meta.clients.gymnasium_env:TaskEnv",
                vector_entry_point="bidex_meta.clients.gymnasium_ids:make_class_world",
                kwargs={"task_name": name},
            )


_METAWORLD = ("vector_strategy", "meta_batch_size", "total_tasks_per_cls", "env_name")
"""Keywords of Meta-World's that ask for its kind of vector environment."""


def make_suite_world(
    suite: str,
    split: str,
    num_envs: int = 1,
    seed: int | None = None,
    benchmark_seed: int | None = None,
    render_mode: str | None = None,
    stagger: bool = False,
    **options: Any,
) -> "World | VectorEnv":
    """What `gymnasium.make_vec("bidex-meta/MT4-v1", num_envs=...)` calls.

    Args:
        suite: Name of the suite.
        split: `"train"` or `"test"`.
        num_envs: Rows over all classes.
        seed: Chooses the tasks, the starts and the task draws; None: 0.
        benchmark_seed: Chooses the tasks instead, and the rest where there is no seed.
        render_mode: None or `"rgb_array"`, which are the same: a world draws when it is asked to.
        stagger: As in `Benchmark.make_world`, but left out: not, since who counts for himself would count those.
        **options: The other keywords of `Benchmark.make_world`. With `vector_strategy`, `meta_batch_size`,
            `total_tasks_per_cls` or `env_name` those of Meta-World's ids, and what comes is what `metaworld` gives:
            single environments of NumPy arrays side by side, however many `num_envs` says.
    """
    check_render_mode(render_mode)
    of_tasks = next(given for given in (benchmark_seed, seed, 0) if given is not None)
    if any(name in options for name in _METAWORLD):
        from bidex_meta.metaworld.vector_envs import make_split

        return make_split(suite, split, of_tasks, **options)
    from bidex_meta.benchmark import Benchmark

    benchmark = Benchmark(suite, seed=of_tasks)
    return benchmark.make_world(split, num_envs=num_envs, seed=seed, stagger=stagger, **options)


def make_class_world(
    task_name: str, num_envs: int = 1, render_mode: str | None = None, stagger: bool = False, **options: Any
) -> "World":
    """What `gymnasium.make_vec("bidex-meta/CatchUnderarm-v1", num_envs=...)` calls.

    Args:
        task_name: Name of the task class.
        num_envs: Rows.
        render_mode: As in `make_suite_world`.
        stagger: As in `make_suite_world`.
        **options: The other keywords of `make_task_world`.
    """
    from bidex_meta.benchmark import make_task_world

    check_render_mode(render_mode)
    return make_task_world(task_name, num_envs=num_envs, stagger=stagger, **options)


def check_render_mode(render_mode: str | None) -> None:
    """Refuses what cannot be drawn.

    Raises:
        BidexError: Neither None nor `"rgb_array"`.
    """
    if not isinstance(render_mode, str | None) or render_mode not in (None, "rgb_array"):
        raise BidexError(f"render_mode: expected None or 'rgb_array', got {shortened(render_mode)}.")

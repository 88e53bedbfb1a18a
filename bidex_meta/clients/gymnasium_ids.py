"""Gymnasium ids of the shipped suites and of the task classes.

An id of a suite makes only vector environments. An id of a task class makes single and vector environments.
"""

import inspect
import secrets
from itertools import product
from typing import Any

import gymnasium
from gymnasium.vector import VectorEnv

from bidex_meta.errors import BidexError, shortened, unknown_name
from bidex_meta.rules import plain_name
from bidex_meta.suite import Suite
from bidex_meta.suite_files import load_suite, suite_names
from bidex_meta.tasks import registry

NAMESPACE = "bidex-meta"
OF_SINGLES = frozenset({"vector_strategy", "meta_batch_size", "total_tasks_per_cls", "env_name"})
"""Options with which an id of a suite makes Meta-World's vector of single environments instead of a world."""


def suite_ids(suite: Suite) -> dict[str, str]:
    """Map the Gymnasium ids of a suite to the splits that they stand for, e.g. `{"bidex-meta/MT4-v1": "train"}`."""
    name = suite.name.removesuffix("-v2")
    version = f"v{suite.version}"
    if suite.kind == "multi-task":
        return {f"{NAMESPACE}/{name}-{version}": "train"}
    return {f"{NAMESPACE}/{name}-{split}-{version}": split for split in suite.splits}


def task_id(task_name: str) -> str:
    """Return the Gymnasium id of a task class: `"bidex-meta/CatchUnderarm-v1"`, or `-v2` for `CatchUnderarm-v2`."""
    return f"{NAMESPACE}/{task_name}" + ("" if task_name != plain_name(task_name) else "-v1")


def register_ids() -> None:
    """Register all ids; ids that are already registered are not changed."""
    for name in suite_names():
        for env_id, split in suite_ids(load_suite(name)).items():
            _register(env_id, None, f"{__name__}:make_suite_world", suite=name, split=split)
    for kind in ("mt", "ml"):
        _register(f"{NAMESPACE}/custom-{kind}-envs", None, "bidex_meta.metaworld.vector_envs:make_custom")
    trials = "bidex_meta.clients.trial_env"
    _register(f"{NAMESPACE}/trials", f"{trials}:TrialEnv", f"{trials}:make_trials")
    for name, version in product(registry.names(), ("", "-v2")):
        task_name = name + version
        single = "bidex_meta.clients.gymnasium_env:TaskEnv"
        _register(task_id(task_name), single, f"{__name__}:make_class_world", task_name=task_name)


def _register(env_id: str, single: str | None, vector: str, **arguments: str) -> None:
    """Register an id with its entry points and their arguments, unless the id is registered already."""
    if env_id not in gymnasium.registry:
        gymnasium.register(env_id, single, vector_entry_point=vector, kwargs=arguments)


def make_suite_world(
    suite: str, split: str, num_envs: int = 1, seed: int | None = None, benchmark_seed: int | None = None,
    render_mode: str | None = None, stagger: bool = False, **options: Any
) -> VectorEnv:  # fmt: skip
    """Make the world of `gymnasium.make_vec("bidex-meta/MT4-v1", num_envs=...)`, with environments of all classes.

    `seed` chooses the tasks. It also seeds the starts and the draws of a task for each episode. If `benchmark_seed` is
    given, it chooses the tasks instead of `seed`; without `seed`, it also seeds starts and draws. If neither seed is
    given, the tasks are those of seed 0, and starts and draws differ each time.

    The render modes, None and `"rgb_array"`, are equivalent, because a world renders only on request. `stagger` lets
    first episodes begin at random elapsed steps. It is off by default, because Gymnasium's wrappers would count these
    shortened episodes. Other arguments are as in `Benchmark.make_world`.

    With `vector_strategy`, `meta_batch_size`, `total_tasks_per_cls` or `env_name` the result is Meta-World's vector of
    single environments with NumPy arrays, and `num_envs` is ignored. These environments have no `stagger`.
    """
    check_render_mode(render_mode)
    task_seed, start_seed = both_seeds(seed, benchmark_seed)
    if options.keys() & OF_SINGLES:
        from bidex_meta.metaworld.vector_envs import make_split

        if stagger:
            raise BidexError("stagger: expected False for Meta-World's vector of single environments. Leave it out.")
        return make_split(suite, split, task_seed, start_seed, render_mode=render_mode, **options)
    from bidex_meta.benchmark import Benchmark

    known = inspect.signature(Benchmark.make_world).parameters
    for name in options.keys() - known:
        fault = unknown_name("option", name, known.keys() - {"self"})
        raise BidexError(f"{fault} Options of Meta-World need vector_strategy, such as 'sync'.")

    benchmark = Benchmark(suite, seed=task_seed)
    return benchmark.make_world(split, num_envs=num_envs, seed=start_seed, stagger=stagger, **options)


def make_class_world(
    task_name: str, num_envs: int = 1, seed: int | None = None, benchmark_seed: int | None = None,
    render_mode: str | None = None, stagger: bool = False, **options: Any
) -> VectorEnv:  # fmt: skip
    """Make the world of `gymnasium.make_vec("bidex-meta/CatchUnderarm-v1", num_envs=...)`.

    Seeds, render modes and `stagger` are as in `make_suite_world`, other options as in `make_task_world`.
    """
    from bidex_meta.benchmark import make_task_world

    check_render_mode(render_mode)
    task_seed, start_seed = both_seeds(seed, benchmark_seed)
    return make_task_world(
        task_name, num_envs=num_envs, seed=start_seed, task_seed=task_seed, stagger=stagger, **options
    )


def both_seeds(seed: int | None, benchmark_seed: int | None = None) -> tuple[int, int]:
    """Return the seeds of tasks and of starts for a Gymnasium environment, from the seeds that were given.

    Without a seed, Gymnasium draws starts from a random seed. The tasks are part of the benchmark and stay the same.
    """
    if benchmark_seed is None:
        given = seed
    else:
        given = benchmark_seed
    if given is None:
        return 0, secrets.randbits(63)
    return given, given if seed is None else seed


def check_render_mode(render_mode: str | None) -> None:
    """Raise BidexError for a render mode other than None and `"rgb_array"`."""
    if not isinstance(render_mode, str | None) or render_mode not in (None, "rgb_array"):
        raise BidexError(f"render_mode: expected None or 'rgb_array', got {shortened(render_mode)}.")

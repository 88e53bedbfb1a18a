"""From a run's config to its worlds and policies: the commands' one way to either."""

from typing import Any

from bidex_meta.commands.launch import launch
from bidex_meta.commands.learners import learner_kind
from bidex_meta.errors import BidexError, unknown_name
from bidex_meta.evaluate import Agent
from bidex_meta.record import RunFolder

EVALUATION_SEED = 1_000_000
"""Seed of the starts in evaluation: not a seed anybody trains with, so that they are new to the policy."""


def check_names(config: dict[str, Any]) -> None:
    """Refuse an unknown suite or task before anything is built.

    Raises:
        BidexError: With the nearest name.
    """
    if config["suite"] is not None:
        from bidex_meta.suite import load_suite

        load_suite(config["suite"])
    else:
        from bidex_meta.tasks import registry

        if config["task"] not in registry.names():
            raise unknown_name("task", config["task"], registry.names())


def training_world(config: dict[str, Any]) -> Any:
    """The world a run trains on."""
    return _world(config, "train", config["num_envs"], "SAME_STEP")


def evaluation_world(config: dict[str, Any], split: str = "train", rows: int | None = None) -> Any:
    """A fresh world with the run's tasks that does not reset by itself.

    Args:
        config: The run's config.
        split: ``train`` or ``test``.
        rows: Rows over all tasks; one per task by default.
    """
    return _world(config, split, rows, "DISABLED")


def _world(config: dict[str, Any], split: str, rows: int | None, mode: str) -> Any:
    from bidex_meta.benchmark import Benchmark, make_task_world

    keywords: dict[str, Any] = {
        "seed": config["seed"],
        "device": launch().own_device(config["device"]),
        "threads": config["threads"],
        "engine": config.get("engine", "auto"),
        "autoreset_mode": mode,
    }
    if config["suite"] is None:
        if split != "train":
            raise BidexError(f"A run on the task {config['task']} alone has no {split} split. Leave --split out.")
        # 50 tasks are drawn for a class on its own.
        return make_task_world(config["task"], num_envs=rows or 50, **keywords)
    benchmark = Benchmark(config["suite"], seed=config["seed"])
    if rows is None:
        tasks = [task.env_name for task in (benchmark.test_tasks if split == "test" else benchmark.train_tasks)]
        # Rows are split evenly over classes, so that all need as many as the class with the most tasks.
        rows = max((tasks.count(name) for name in set(tasks)), default=1) * len(set(tasks)) or 1
    return benchmark.make_world(split, num_envs=rows, **keywords)


def load_policy(folder: RunFolder, device: str) -> tuple[Agent, int]:
    """The policy of a run's newest checkpoint and the environment steps it was trained for.

    Raises:
        BidexError: The run has not saved a checkpoint yet.
    """
    loaded = folder.checkpoints.load()
    if loaded is None:
        raise BidexError(f"{folder.path} has no checkpoint yet. Train on: bidex-meta run --resume {folder.path}")
    state, step = loaded
    return learner_kind(folder.config()["algo"]).make.load_policy(state["learner"]["policy"], device), step

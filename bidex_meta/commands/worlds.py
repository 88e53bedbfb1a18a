"""From a run's config to its worlds and policies: the commands' one way to either."""

from collections.abc import Callable
from typing import Any

from bidex_meta.agents import Agent
from bidex_meta.clients import metaworld
from bidex_meta.commands.learners import learner_kind
from bidex_meta.errors import BidexError, unknown_name
from bidex_meta.evaluation.results import Evaluation
from bidex_meta.evaluation.scores import Reference
from bidex_meta.record import RunFolder
from bidex_meta.train.launch import launch

_TASKS_ALONE = 50
"""Tasks that are drawn for a class on its own."""

_FOREIGN_ROWS = 5
"""Rows of each class in Meta-World's evaluation worlds: its tasks are played in turns, and 5 divides 50."""


def check_names(config: dict[str, Any]) -> None:
    """Refuse an unknown suite or task before anything is built.

    Raises:
        BidexError: With the nearest name.
    """
    if metaworld.is_foreign(config["suite"]):
        metaworld.class_names(config["suite"])
    elif config["suite"] is not None:
        from bidex_meta.suite import load_suite

        load_suite(config["suite"])
    else:
        from bidex_meta.tasks import registry

        if config["task"] not in registry.names():
            raise unknown_name("task", config["task"], registry.names())


def training_world(config: dict[str, Any], mode: str = "SAME_STEP") -> Any:
    """The world a run trains on.

    Args:
        config: The run's config.
        mode: Autoreset mode: what the learner's class says, SAME_STEP where it says nothing.
    """
    return _world(config, "train", config["num_envs"], mode)


def evaluation_world(config: dict[str, Any], split: str = "train", rows: int | None = None) -> Any:
    """A fresh world with the run's tasks that does not reset by itself.

    Args:
        config: The run's config.
        split: ``train`` or ``test``.
        rows: Rows over all tasks; one per task by default (a few per class where the suite is Meta-World's).
    """
    return _world(config, split, rows, "DISABLED")


def splits(config: dict[str, Any]) -> list[str]:
    """The splits of a run's suite: ``train``, and ``test`` where there is one."""
    if config["suite"] is None or metaworld.is_foreign(config["suite"]):
        return ["train"]
    from bidex_meta.suite import load_suite

    return list(load_suite(config["suite"]).splits)


def task_counts(config: dict[str, Any], split: str) -> list[int]:
    """Tasks in the pool of each slot of an evaluation world."""
    if config["suite"] is None:
        return [_TASKS_ALONE]
    from bidex_meta.benchmark import Benchmark

    benchmark = Benchmark(config["suite"], seed=config["seed"])
    names = [task.env_name for task in (benchmark.test_tasks if split == "test" else benchmark.train_tasks)]
    if benchmark.suite.task_id != "class":
        return [1] * len(names)
    return [names.count(name) for name in dict.fromkeys(names)]


def judge(config: dict[str, Any], agent: Agent, world: Any, episodes: int | None, seed: int) -> Evaluation:
    """Evaluate a policy on all tasks of an evaluation world, beside the references of the normalised score.

    Args:
        config: The run's config.
        agent: The policy.
        world: What ``evaluation_world`` made of the config.
        episodes: Episodes of each task; None takes ``default_episodes``.
        seed: Of the starts.
    """
    episodes = default_episodes(config) if episodes is None else episodes
    if metaworld.is_foreign(config["suite"]):
        from bidex_meta.clients.metaworld_world import evaluate_all_tasks

        return evaluate_all_tasks(agent, world, episodes, seed=seed)
    from bidex_meta.evaluation.play import evaluate

    return evaluate(agent, world, episodes, seed=seed, references=references_of(config))


def references_of(config: dict[str, Any]) -> dict[str, Reference]:
    """The references of the normalised score and of broken episodes, of which those of other bases are none."""
    from bidex_meta.evaluation.references import references

    return references() if has_moving_bases(config) else {}


def has_moving_bases(config: dict[str, Any]) -> bool:
    """Whether a run's hands move as those of the shipped suites do, and of the references."""
    from bidex_meta.tasks import registry

    if config["task"] is not None:
        return registry.get(config["task"], _asked_base(config)).moving_base
    from bidex_meta.suite import load_suite

    suite = load_suite(config["suite"])
    return suite.base == "moving" or all(registry.get(entry.name).moving_base for entry in suite.classes)


def _asked_base(config: dict[str, Any]) -> bool | None:
    """Whether bases were asked to move; None: as the class has it."""
    return {"own": None, "moving": True, "fixed": False}[config.get("base", "own")]


def default_episodes(config: dict[str, Any]) -> int:
    """Episodes of each task: 4, but 1 where a task fixes its start, so that a policy would only repeat itself."""
    return 1 if metaworld.is_foreign(config["suite"]) else 4


def _world(config: dict[str, Any], split: str, rows: int | None, mode: str) -> Any:
    if metaworld.is_foreign(config["suite"]):
        return _foreign_world(config, split, rows, mode)
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
        keywords["moving_base"] = _asked_base(config)
        return make_task_world(config["task"], num_envs=rows or _TASKS_ALONE, **keywords)
    benchmark = Benchmark(config["suite"], seed=config["seed"])
    if rows is None:
        tasks = [task.env_name for task in (benchmark.test_tasks if split == "test" else benchmark.train_tasks)]
        # Rows are split evenly over classes, so that all need as many as the class with the most tasks.
        rows = max((tasks.count(name) for name in set(tasks)), default=1) * len(set(tasks)) or 1
    return benchmark.make_world(split, num_envs=rows, **keywords)


def _foreign_world(config: dict[str, Any], split: str, rows: int | None, mode: str) -> Any:
    suite, device, engine = config["suite"], config["device"], config.get("engine", "auto")
    if split != "train":
        raise BidexError(f"{suite} has the split train alone, got {split!r}. Leave --split out.")
    if not device.startswith("cpu") or engine == "warp":
        wrong = f"--device {device}" if engine != "warp" else "--engine warp"
        raise BidexError(f"Meta-World's environments run on the CPU in C MuJoCo, got {wrong}. Add --device cpu.")
    from bidex_meta.clients.metaworld_world import MetaWorldWorld

    rows = rows or _FOREIGN_ROWS * len(metaworld.class_names(suite))
    return MetaWorldWorld(suite, rows, seed=config["seed"], autoreset_mode=mode)


def checkpoint(folder: RunFolder) -> tuple[dict[str, Any], int]:
    """State and environment steps of a run's newest checkpoint.

    Raises:
        BidexError: The run has not saved one yet.
    """
    loaded = folder.checkpoints.load()
    if loaded is None:
        raise BidexError(f"{folder.path} has no checkpoint yet. Train on: bidex-meta run --resume {folder.path}")
    return loaded


def load_policy(folder: RunFolder, device: str) -> tuple[Agent, int]:
    """The policy of a run's newest checkpoint and the environment steps it was trained for.

    Raises:
        BidexError: The run has not saved a checkpoint yet.
    """
    load, step = policy_loader(folder, device)
    return load(), step


def policy_shape(state: dict[str, Any]) -> dict[str, int]:
    """Numbers of ``observations`` and ``actions`` of the policy in a run's ``checkpoint``."""
    return state["learner"]["policy"]["shape"]


def policy_of(folder: RunFolder, state: dict[str, Any], device: str) -> Agent:
    """The policy in a run's ``checkpoint``."""
    return learner_kind(folder.config()["algo"]).make.load_policy(state["learner"]["policy"], device)


def policy_loader(folder: RunFolder, device: str) -> tuple[Callable[[], Agent], int]:
    """What makes the policy of a run's newest checkpoint anew, as often as it is asked, and that checkpoint's steps.

    The checkpoint is read once: a run that trains on meanwhile gives no other.

    Raises:
        BidexError: The run has not saved a checkpoint yet.
    """
    state, step = checkpoint(folder)
    return lambda: policy_of(folder, state, device), step

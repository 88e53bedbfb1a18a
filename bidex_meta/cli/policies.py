"""From a run folder to its policy: the commands' one way."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import torch

from bidex_meta.agents import Agent
from bidex_meta.cli.conditions import say_differences
from bidex_meta.cli.learners import learner_kind
from bidex_meta.cli.parsing import LookFlags
from bidex_meta.cli.tables import Json, say
from bidex_meta.engine.choice import checked_device
from bidex_meta.errors import BidexError, known_name, one_line
from bidex_meta.evaluation.play import RandomAgent, ZeroAgent
from bidex_meta.runs import RunFolder
from bidex_meta.suite import rules_apart
from bidex_meta.tasks.registry import name_among
from bidex_meta.train.distributed import LostProcess
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.files import is_file
from bidex_meta.utils.plugins import name_with_object
from bidex_meta.world.contract import TaskWorld
from bidex_meta.worlds import WorldConfig, Worlds


def checkpoint(folder: RunFolder, which: str = "last", noted: bool = False) -> tuple[Json, int]:
    """State and environment steps of a run's checkpoint; BidexError where there is none such.

    Says how the run's record differs from this installation and the run's suite, unless that was ``noted`` before.

    ``which`` is ``last``, the newest one; ``best``, of which the state holds the policy alone; or a file, by its path
    or by its name in the run's folder of checkpoints.
    """
    loaded = _loaded(folder, which)
    if not noted:
        say_differences(folder)
    return loaded


def _loaded(folder: RunFolder, which: str) -> tuple[Json, int]:
    if which == "best":
        if not folder.checkpoints.best.is_file():
            raise BidexError(
                f"{folder.path} has no best.pt: it was not evaluated while training (run --evaluate-every N). Use "
                "--checkpoint last."
            )
        return folder.checkpoints.load_one(folder.checkpoints.best)
    if which != "last":
        own = folder.checkpoints.folder / which
        return folder.checkpoints.load_one(own if is_file(own) else Path(which))
    loaded = folder.checkpoints.load()
    if loaded is None:
        raise BidexError(f"{folder.path} has no checkpoint yet. Train on: bidex-meta run --resume {folder.path}")
    return loaded


@contextlib.contextmanager
def fitting(path: Path) -> Iterator[None]:
    """What happens within puts a run's checkpoint into what its config describes; each error says that it does not fit.

    A checkpoint may be of another version, or of anybody: its tensors and words can be any.
    """
    try:
        yield
    except (BidexError, LostProcess):
        raise
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        reason = f"{type(error).__name__}: {one_line(error)[:200].rstrip('.')}"
        raise BidexError(
            f"The checkpoint of {path} does not fit its config ({reason}). Use the version in versions.json, or start "
            "a new run."
        ) from error


@checked_arguments
def load_policy(folder: RunFolder, device: str | torch.device, which: str = "last") -> tuple[Agent, int]:
    """The policy of a run's checkpoint and the environment steps it was trained for; errors as of ``checkpoint``."""
    load, step = policy_loader(folder, str(checked_device(device)), which)
    return load(), step


def policy_of(folder: RunFolder, state: Json, device: str) -> Agent:
    """The policy in a run's checkpoint; BidexError where it does not fit the run's config, or its own."""
    with fitting(folder.path):
        return learner_kind(folder.config().algo).make.load_policy(state["learner"]["policy"], device)


def policy_loader(folder: RunFolder, device: str, which: str = "last") -> tuple[Callable[[], Agent], int]:
    """What makes the policy of a run's checkpoint anew with each call, and that checkpoint's steps.

    The checkpoint is read once: a run that trains on meanwhile gives no other.
    """
    state, step = checkpoint(folder, which)
    return lambda: policy_of(folder, state, device), step


def acting(policy: str, world: TaskWorld, seed: int, which: str = "last") -> Agent:
    """What acts in a world to be looked at: ``zero``, ``random``, or the policy of a run folder, which must fit it."""
    if policy == "zero":
        return ZeroAgent(world.action_space)
    if policy == "random":
        return RandomAgent(world.action_space, seed)
    folder = RunFolder.open(Path(policy))
    state, _ = checkpoint(folder, which)
    with fitting(folder.path):
        shape: Json = state["learner"]["policy"].get("shape", {})
    spaces = {"observations": world.single_observation_space, "actions": world.single_action_space}
    given = {name: space.shape[0] for name, space in spaces.items()}
    if any(shape.get(name, size) != size for name, size in given.items()):
        raise BidexError(
            f"The policy of {policy} takes {shape['observations']} observations and gives {shape['actions']} "
            f"actions, but here are {given['observations']} and {given['actions']}. Leave --suite out, or name the "
            "policy's own."
        )
    return policy_of(folder, state, "cpu")


def looked_at(flags: LookFlags, all_slots: bool = False) -> tuple[Worlds, list[str], str]:
    """The worlds in which a policy is looked at, the class of each slot, and the class to look at.

    Those of its run, or of the suite or the task that is named.
    """
    if flags.object is not None and (flags.suite is not None or flags.task is None):
        raise BidexError("--object goes with --task alone: bidex-meta render --task CatchUnderarm --object mug ...")
    config = WorldConfig(suite=flags.suite, task=flags.task, object=flags.object, threads=1, seed=flags.seed)
    if flags.actor not in ("zero", "random"):
        run = RunFolder.open(Path(flags.actor)).config()
        config = replace(config, suite=config.suite or run.suite, task=config.task or run.task)
        config = replace(config, base=run.base, points=run.points)
        if not flags.task and not flags.object:
            config = replace(config, object=run.object)
    if config.suite is None and config.task is None:
        raise BidexError("Name what to show: a run folder, --task TASK or --suite SUITE.")
    worlds = Worlds.open(config)
    slots, classes = slots_of(worlds), worlds.task_classes()  # which refuses what is not of ours
    if flags.actor not in ("zero", "random"):
        say_other_rules(RunFolder.open(Path(flags.actor)), worlds)
    task = name_among(name_with_object(flags.task, flags.object), classes) if flags.task else slots[0]
    return worlds, slots, task if all_slots else known_name(f"task of {worlds.name}", task, classes)


def say_other_rules(folder: RunFolder, worlds: Worlds) -> None:
    """Say in one line how the rules that a run's policy has learned by differ from those of some worlds, if they do."""
    with contextlib.suppress(BidexError):  # the suite's file of the run may be gone
        learned = Worlds.open(folder.config().to_json())
        if learned.rules and worlds.rules and (apart := rules_apart(vars(learned.rules), worlds.rules)):
            say(f"Note: {folder.path} learned {learned.name} by other rules than those of {worlds.name}: {apart}.")


def slots_of(worlds: Worlds) -> list[str]:
    """The class of each slot of some worlds; a slot of listed tasks is named Class/task."""
    return [name.split("/")[0] for name in worlds.tasks("train")]

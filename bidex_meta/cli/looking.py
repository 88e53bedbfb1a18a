"""Worlds and policies for commands that show them: pictures, films, the viewers."""

from dataclasses import replace
from pathlib import Path

from bidex_meta.agents import Agent
from bidex_meta.cli.parsing import LookFlags
from bidex_meta.errors import BidexError, known_name
from bidex_meta.evaluation.play import RandomAgent, ZeroAgent
from bidex_meta.experiments.policies import fitting, load_checkpoint, policy_of, say_other_rules, slots_of
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import Json
from bidex_meta.tasks.registry import name_among
from bidex_meta.utils.plugins import name_with_object
from bidex_meta.world.contract import TaskWorld
from bidex_meta.worlds import Worlds, WorldsConfig, open_worlds


def acting(policy: str, world: TaskWorld, seed: int, which: str = "last") -> Agent:
    """Return the agent that acts in the world of a picture, a film or a viewer.

    ``policy`` is ``zero``, ``random`` or the folder of a run; ``which`` is the run's checkpoint. Raises BidexError if
    the policy does not fit the world.
    """
    if policy == "zero":
        return ZeroAgent(world.action_space)
    if policy == "random":
        return RandomAgent(world.action_space, seed)
    folder = RunFolder.open(Path(policy))
    state, _ = load_checkpoint(folder, which)
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
    """Return what a picture, film or viewer shows: the worlds, the class of each of their slots, and the class to show.

    A slot is a class or a listed task. The flags name the suite or the task of the worlds. If they name none, the
    worlds are those of the policy's run. Raises BidexError for an unknown class, and if there is nothing to show.
    """
    if flags.object is not None and (flags.suite is not None or flags.task is None):
        raise BidexError("--object goes with --task alone: bidex-meta render --task CatchUnderarm --object mug ...")
    config = WorldsConfig(suite=flags.suite, task=flags.task, object=flags.object, threads=1, seed=flags.seed or 0)
    if flags.actor not in ("zero", "random"):
        run = RunFolder.open(Path(flags.actor)).config()
        if flags.suite is None:
            config = replace(config, tasks_per_class=run.tasks_per_class)
        if flags.seed is None:
            config = replace(config, seed=run.seed, task_seed=run.task_seed)
        config = replace(config, suite=config.suite or run.suite, task=config.task or run.task)
        config = replace(config, base=run.base, points=run.points, touch=run.touch)
        if flags.suite is None and flags.task is None:
            config = replace(config, switches=run.switches)
        own_task = flags.task is None or flags.task.casefold() == str(run.task).casefold()
        if own_task and flags.suite is None and flags.object is None:
            config = replace(config, object=run.object)
    if config.suite is None and config.task is None:
        raise BidexError("Name what to show: a run folder, --task TASK or --suite SUITE.")
    worlds = open_worlds(config)
    slots = slots_of(worlds)
    classes = worlds.task_classes()  # raises BidexError for worlds of other libraries
    if flags.actor not in ("zero", "random"):
        say_other_rules(RunFolder.open(Path(flags.actor)), worlds)
    if flags.task:
        task = name_among(name_with_object(flags.task, config.object), classes)
    else:
        task = slots[0]
    return worlds, slots, task if all_slots else known_name(f"task of {worlds.name}", task, classes)

"""Measure whether a suite tests adaptation.

It does only if, for example, a policy that does not know the task fails, and rewards reveal the task.
"""

from collections.abc import Collection, Sequence
from dataclasses import asdict, replace
from itertools import chain
from pathlib import Path

import numpy as np

from bidex_meta.agents import Agent
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.memorisation import memorised
from bidex_meta.evaluation.play import HeldAgent, RandomAgent, ZeroAgent, evaluate
from bidex_meta.evaluation.results import ClassResult
from bidex_meta.evaluation.task_inference import alignment, blind_ceiling, identifiability, listed_ceiling
from bidex_meta.experiments.policies import load_policy, say_other_rules
from bidex_meta.rules import plain_name
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import Json
from bidex_meta.training.launch import say
from bidex_meta.witness.demonstrators import OpenLoopReplay, Scripted
from bidex_meta.witness.scripts import scripts_of
from bidex_meta.witness.store import load_witness, witness_path
from bidex_meta.world import Slot, World, WorldConfig
from bidex_meta.worlds import Worlds, WorldsConfig, open_worlds

_NOTHING = ("uniform", "zero", "held")  # untrained policies


def validity_rows(worlds: Worlds, runs: Sequence[Path]) -> dict[str, Json]:
    """Measure, for each class, whether a policy must and can find out the task; return a row per class.

    For example, a row has the success of policies that do not know the task, and of policies that know it. ``runs`` are
    folders of runs whose policies know the tasks. If a class is in both splits, its test tasks are measured. Raises
    BidexError for suites without hands (Meta-World), for runs whose policies do not see the goal, and for folders
    without a name of their own.
    """
    _check_runs(runs)
    rows: dict[str, Json] = {}
    for split in reversed(worlds.splits):
        if not rows.keys() >= worlds.tasks(split).keys():
            rows = _of_split(worlds, split, runs) | rows
    return {name: rows[name] for name in chain.from_iterable(map(worlds.tasks, worlds.splits))}


def _check_runs(runs: Sequence[Path]) -> None:
    known = {"uniform", "zero", "held", "witness", "script", "misled"}
    for path in runs:
        folder = RunFolder.open(path)
        worlds = open_worlds(folder.config().to_json())
        if worlds.hides_goals:
            raise BidexError(
                f"--policy {path} learned {worlds.name}, which hides goals: it does not know the task. Name a run on a "
                "suite that shows goals, or on a single class."
            )
        if folder.path.name in known:
            raise BidexError(f"--policy {path}: {folder.path.name} already names a policy. Rename the folder.")
        known.add(folder.path.name)


def blind_share(slot: Slot, worlds: Worlds) -> float:
    """Return the highest possible success of a policy that does not know which of the suite's tasks it is in."""
    if worlds.suite is not None and any(entry.name == slot.name and entry.tasks for entry in worlds.suite.classes):
        return listed_ceiling(slot.task_class, slot.tasks)
    return blind_ceiling(slot.task_class, seed=worlds.seed)


def _of_split(worlds: Worlds, split: str, runs: Sequence[Path]) -> dict[str, Json]:
    """Return the results of :func:`validity_rows` for the classes of one split."""
    world = worlds.world(split)
    if not isinstance(world, World):
        raise BidexError(f"Expected a suite of hands, got {worlds.name}.")
    results = _results(worlds, world, runs)
    say("what first observations tell")
    starts = memorised(world, seed=worlds.seed)
    rows: dict[str, Json] = {}
    for slot in world.slots:
        found = results[slot.name]
        hidden = list(chain.from_iterable(part.names for part in slot.task_class.hides()))
        known = {name: result.success for name, result in found.items() if name not in (*_NOTHING, "witness", "misled")}
        aligned = alignment(found)
        identified = _identified(slot, worlds) if hidden else {"identified": None}
        untrained = {name: found[name].success if name in found else None for name in (*_NOTHING, "witness")}
        rows[slot.name] = {
            "hidden": hidden,
            "blind": blind_share(slot, worlds),
            **identified,
            **untrained,
            **asdict(starts[slot.name]),
            "solved": max(known.values(), default=None),
            "alignment": aligned and asdict(aligned),
            "policies": {name: [each.success, each.mean_return] for name, each in found.items()},
        }
    world.close()
    return rows


def _witnesses(world: World) -> OpenLoopReplay:
    """Return an agent that replays a stored action sequence, the class's witness, in every task of a class.

    The sequence solves task 0 of version 1 of the class; in other tasks it need not succeed.
    """
    known = {name: load_witness(plain_name(name)) for name in _with_witness(world)}
    return OpenLoopReplay(known, list(world.task_names), world.task_id, world.action_size)


def _with_witness(world: World) -> list[str]:
    names = [slot.name for slot in world.slots if slot.task_class.moving_base]
    return [name for name in names if witness_path(plain_name(name)).is_file()]


def _scripted(world: World) -> list[str]:
    moving = [slot for slot in world.slots if slot.task_class.moving_base]
    return [slot.name for slot in moving if slot.task_class.name in scripts_of(slot.task_class.rules)]


def _identified(slot: Slot, worlds: Worlds) -> Json:
    """Measure how well the rewards of one exploring episode reveal the hidden values of a class's tasks.

    Several exploring policies are tried, and the best result is returned: the share of tasks whose hidden values were
    identified, and the 90 % quantile of the errors in units of the task's tolerance.
    """
    say(f"{slot.name}: what rewards tell")
    world = World([slot], WorldConfig(len(slot.tasks), engine="c", threads=worlds.threads, autoreset_mode="DISABLED"))
    explorers: list[Agent | None] = [None]
    explorers += [_witnesses(world)] if _with_witness(world) else []
    explorers += [Scripted(world, misled=True)] if _scripted(world) else []
    found = max((identifiability(world, each, worlds.seed) for each in explorers), key=lambda each: each.share)
    world.close()
    return {"identified": found.share, "error_90": float(np.quantile(found.errors, 0.9))}


def _results(worlds: Worlds, world: World, runs: Sequence[Path]) -> dict[str, dict[str, ClassResult]]:
    """Evaluate simple policies, scripted policies and the policies of ``runs`` on the classes of a split.

    Returns the results by class and then by policy; a class has only results of policies that can act in it.
    """
    scripted = _scripted(world)
    agents: dict[str, tuple[Agent, Collection[str]]] = {
        "uniform": (RandomAgent(world.action_space, worlds.seed), world.task_names),
        "zero": (ZeroAgent(world.action_space), world.task_names),
        "held": (HeldAgent(world.action_space, worlds.seed), world.task_names),
        "witness": (_witnesses(world), _with_witness(world)),
        "script": (Scripted(world, names=scripted), scripted),
        "misled": (Scripted(world, names=scripted, misled=True), scripted),
    }
    results: dict[str, dict[str, ClassResult]] = {name: {} for name in world.task_names}
    for name, (agent, classes) in agents.items():
        if classes:
            say(f"{name} actions in all tasks")
            found = evaluate(agent, world, 1, references={}).classes
            for each in classes:
                results[each][name] = found[each]
    rules = {slot.name: slot.task_class.rules for slot in world.slots}
    for path in runs:
        say(f"the policy of {path}")
        folder = RunFolder.open(path)
        config = replace(WorldsConfig.of(folder.config().to_json()), task_seed=worlds.seed, threads=worlds.threads)
        own = open_worlds(config)
        say_other_rules(folder, worlds)
        agent, _ = load_policy(folder, "cpu")
        world_of_run = own.world()
        played = own.evaluate(agent, world_of_run, own.protocol("train", 1))
        world_of_run.close()
        for name, result in played.classes.items():
            if rules.get(plain_name(name)) == own.task_classes()[name].rules:
                results[plain_name(name)][folder.path.name] = result
    return results

"""``bidex-meta validity``: measure if there is something to learn about the tasks of a suite."""

import json
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from bidex_meta.agents import Agent
from bidex_meta.cli.parsing import JsonSwitch, parse
from bidex_meta.cli.tables import Json, plain_table, print_table
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.play import HeldAgent, RandomAgent, ZeroAgent, evaluate
from bidex_meta.evaluation.results import ClassResult
from bidex_meta.evaluation.task_inference import alignment, blind_ceiling, identifiability
from bidex_meta.experiments.policies import load_policy, say_other_rules
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import check_writable, write_json
from bidex_meta.runs.versions import collect_versions
from bidex_meta.suite import plain_name
from bidex_meta.training.launch import say
from bidex_meta.utils.files import portable
from bidex_meta.utils.validation import Seed, Threads
from bidex_meta.witness.demonstrators import OpenLoopReplay, Scripted
from bidex_meta.witness.scripts import scripts_of
from bidex_meta.witness.store import load_witness, witness_path
from bidex_meta.world import Slot, World, WorldConfig
from bidex_meta.worlds import Worlds, WorldsConfig


@dataclass(frozen=True)
class ValidityFlags:
    """Measure whether there is something to learn about the tasks of a suite.

    Example: bidex-meta validity --suite ML20-v2 --out validity.json

    For each class: the success on unseen tasks that a policy can have at best without knowing what a task hides; how
    often the rewards of one exploring episode (rough actions, a witness's or a misled script's with noise) identify the
    hidden parts; the success of policies that have learned nothing, and of scripts and runs that know the task; and
    whether return and success agree over all their episodes.
    """

    suite: str = "ML20-v2"
    """Suite, or a suite file; its train tasks are measured, of a meta suite its test tasks too."""
    policy: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction] = ()
    """Folder of a run whose policy knows the tasks: of this suite's rules, or of some of its classes."""
    seed: Seed = 0
    """Seed of tasks, starts and actions."""
    threads: Threads | None = None
    """Threads of the physics; None: one per core."""
    out: Path | None = None
    """JSON file that takes the table."""
    json: JsonSwitch = False


def main(arguments: Sequence[str]) -> None:
    """Measure, print, and store if ``--out`` is given."""
    flags = parse(ValidityFlags, arguments, "validity")
    if flags.out is not None:
        check_writable(flags.out)
    worlds = Worlds.open(WorldsConfig(suite=flags.suite, seed=flags.seed, threads=flags.threads))
    rows = {name: row for split in worlds.splits for name, row in _of_split(worlds, split, flags).items()}
    made = {"suite": portable(flags.suite), "seed": flags.seed, "versions": collect_versions()}
    if flags.out is not None:
        write_json(flags.out, made | {"classes": rows})
    if flags.json:
        print(json.dumps(rows, indent=2))
        return
    print_table(
        plain_table(["class", "hidden", *_SHARES, "aligned"], [_cells(name, row) for name, row in rows.items()])
    )


_SHARES = ("blind", "identified", "uniform", "zero", "held", "witness", "solved")
_NOTHING = ("uniform", "zero", "held")  # policies that have learned nothing


def _cells(name: str, row: Json) -> list[str]:
    shares = ("" if row[key] is None else f"{100 * row[key]:.1f} %" for key in _SHARES)
    if row["alignment"] is None:
        rank = ""
    else:
        rank = f"{row['alignment']['rank']:.2f}"
    return [name, ", ".join(row["hidden"]) or "nothing", *shares, rank]


def _of_split(worlds: Worlds, split: str, flags: ValidityFlags) -> dict[str, Json]:
    """Return the row of each class of a split."""
    world = worlds.world(split)
    if not isinstance(world, World):
        raise BidexError(f"Expected a suite of hands, got {flags.suite}.")
    results = _results(worlds, world, flags)
    rows: dict[str, Json] = {}
    for slot in world.slots:
        found = results[slot.name]
        hidden = [name for part in slot.task_class.hides() for name in part.names]
        known = {name: result.success for name, result in found.items() if name not in (*_NOTHING, "witness", "misled")}
        aligned = alignment(found)
        rows[slot.name] = {
            "hidden": hidden,
            "blind": blind_ceiling(slot.task_class, seed=flags.seed),
            **(_identified(slot, flags) if hidden else {"identified": None}),
            **{name: found[name].success if name in found else None for name in (*_NOTHING, "witness")},
            "solved": max(known.values(), default=None),
            "alignment": aligned and asdict(aligned),
            "policies": {name: [each.success, each.mean_return] for name, each in found.items()},
        }
    world.close()
    return rows


def _witnesses(world: World) -> OpenLoopReplay:
    """Return an agent that replays, in all tasks, the witnesses of version 1's task 0 of a world's classes."""
    known = {name: load_witness(plain_name(name)) for name in _with_witness(world)}
    return OpenLoopReplay(known, list(world.task_names), world.task_id, world.action_size)


def _with_witness(world: World) -> list[str]:
    names = [slot.name for slot in world.slots if slot.task_class.moving_base]
    return [name for name in names if witness_path(plain_name(name)).is_file()]


def _scripted(world: World) -> list[str]:
    moving = [slot for slot in world.slots if slot.task_class.moving_base]
    return [slot.name for slot in moving if slot.task_class.name in scripts_of(slot.task_class.rules)]


def _identified(slot: Slot, flags: ValidityFlags) -> Json:
    """Measure how well the best exploring episode identifies the hidden parts of a class."""
    say(f"{slot.name}: what rewards tell")
    world = World([slot], WorldConfig(len(slot.tasks), engine="c", threads=flags.threads, autoreset_mode="DISABLED"))
    explorers: list[Agent | None] = [None]
    explorers += [_witnesses(world)] if _with_witness(world) else []
    explorers += [Scripted(world, misled=True)] if _scripted(world) else []
    found = max((identifiability(world, each, flags.seed) for each in explorers), key=lambda each: each.share)
    world.close()
    return {"identified": found.share, "error_90": float(np.quantile(found.errors, 0.9))}


def _results(worlds: Worlds, world: World, flags: ValidityFlags) -> dict[str, dict[str, ClassResult]]:
    """Return the results by class and policy, for each class that a policy plays."""
    scripted = _scripted(world)
    agents: dict[str, tuple[Agent, Collection[str]]] = {
        "uniform": (RandomAgent(world.action_space, flags.seed), world.task_names),
        "zero": (ZeroAgent(world.action_space), world.task_names),
        "held": (HeldAgent(world.action_space, flags.seed), world.task_names),
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
    for path in flags.policy:
        say(f"the policy of {path}")
        folder = RunFolder.open(path)
        config = replace(WorldsConfig.of(folder.config().to_json()), task_seed=flags.seed, threads=flags.threads)
        own = Worlds.open(config)
        say_other_rules(folder, worlds)
        agent, _ = load_policy(folder, "cpu")
        for name, result in own.judge(agent, own.world(), own.protocol("train", 1)).classes.items():
            if rules.get(plain_name(name)) == own.task_classes()[name].rules:
                results[plain_name(name)][folder.path.name] = result
    return results

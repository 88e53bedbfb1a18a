"""``bidex-meta validity``: whether there is something to learn about the tasks of a suite."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bidex_meta.cli.parsing import JsonSwitch, parse
from bidex_meta.cli.tables import Json, plain_table, print_table, say
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.play import EVALUATION_SEED, HeldAgent, RandomAgent, ZeroAgent, evaluate
from bidex_meta.evaluation.task_inference import blind_ceiling, identifiability
from bidex_meta.runs.atomic import check_writable, write_json
from bidex_meta.runs.versions import collect_versions
from bidex_meta.utils.validation import Seed, Threads
from bidex_meta.witness.demonstrators import OpenLoopReplay
from bidex_meta.witness.store import load_witness, witness_path
from bidex_meta.world.world import World
from bidex_meta.worlds import WorldConfig, Worlds


@dataclass(frozen=True)
class ValidityFlags:
    """Measure whether there is something to learn about the tasks of a suite.

    Example: bidex-meta validity --suite ML20-v2 --out validity.json

    For each class: the success that a policy can have at best without knowing what a task hides; how often the rewards
    of one exploring episode (rough actions, or a witness's with noise) identify the hidden parts; and the success of
    policies that have learned nothing.
    """

    suite: str = "ML20-v2"
    """Suite, or a suite file; its train tasks are measured, of a meta suite its test tasks too."""
    seed: Seed = 0
    """Seed of tasks, starts and actions."""
    threads: Threads | None = None
    """Threads of the physics; None: one per core."""
    out: Path | None = None
    """JSON file that takes the table."""
    json: JsonSwitch = False


def main(arguments: Sequence[str]) -> None:
    """Measure, print, and store where it was asked."""
    flags = parse(ValidityFlags, arguments, "validity")
    if flags.out is not None:
        check_writable(flags.out)
    worlds = Worlds.open(WorldConfig(suite=flags.suite, seed=flags.seed, threads=flags.threads))
    rows = {name: row for split in worlds.splits for name, row in _of_split(worlds, split, flags).items()}
    made = {"suite": flags.suite, "seed": flags.seed, "versions": collect_versions()}
    if flags.out is not None:
        write_json(flags.out, made | {"classes": rows})
    if flags.json:
        print(json.dumps(rows, indent=2))
        return
    print_table(plain_table(["class", "hidden", *_SHARES], [_cells(name, row) for name, row in rows.items()]))


_SHARES = ("blind", "identified", "uniform", "zero", "held", "witness")


def _cells(name: str, row: Json) -> list[str]:
    shares = ("" if row[key] is None else f"{100 * row[key]:.1f} %" for key in _SHARES)
    return [name, ", ".join(row["hidden"]) or "nothing", *shares]


def _of_split(worlds: Worlds, split: str, flags: ValidityFlags) -> dict[str, Json]:
    """The row of each class of a split."""
    world = worlds.world(split)
    if not isinstance(world, World):
        raise BidexError(f"Expected a suite of hands, got {flags.suite}.")
    witnesses = {n: load_witness(n) for n in world.task_names if witness_path(n).is_file() and worlds.moving_bases}
    size = world.single_action_space.shape[0]
    policies = {
        "uniform": RandomAgent(world.action_space, flags.seed),
        "zero": ZeroAgent(world.action_space),
        "held": HeldAgent(world.action_space, flags.seed),
        "witness": OpenLoopReplay(witnesses, list(world.task_names), world.task_id, size),
    }
    rows: dict[str, Json] = {}
    for slot in world.slots:
        task = slot.task_class
        hidden = [name for part in task.hides() for name in part.names]
        rows[slot.name] = {"hidden": hidden, "blind": blind_ceiling(task, seed=flags.seed), "identified": None}
        if hidden:
            say(f"{slot.name}: what rewards tell")
            one = World([slot], len(slot.tasks), engine="c", threads=flags.threads, autoreset_mode="DISABLED")
            explored = [None, witnesses[slot.name].actions] if slot.name in witnesses else [None]
            identified = max(
                (identifiability(one, each, flags.seed) for each in explored), key=lambda found: found.share
            )
            rows[slot.name] |= {"identified": identified.share, "error_90": float(np.quantile(identified.errors, 0.9))}
    for name, agent in policies.items():
        say(f"{name} actions in all tasks")
        found = evaluate(agent, world, 1, seed=EVALUATION_SEED, references={})
        for slot_name, result in found.classes.items():
            unknown = name == "witness" and slot_name not in witnesses
            rows[slot_name][name] = None if unknown else result.success
    world.close()
    return rows

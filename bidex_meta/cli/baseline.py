"""``bidex-meta baseline``: measure the references of the normalised score."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from bidex_meta.cli.parsing import JsonSwitch, parse
from bidex_meta.cli.tables import evaluation_table, print_table
from bidex_meta.errors import BidexError, known_name
from bidex_meta.evaluation import references
from bidex_meta.evaluation.play import RandomAgent, ZeroAgent, evaluate
from bidex_meta.evaluation.results import Evaluation
from bidex_meta.runs.atomic import check_writable
from bidex_meta.runs.versions import collect_versions
from bidex_meta.utils.files import portable
from bidex_meta.utils.validation import Few, Seed, Threads
from bidex_meta.witness.demonstrators import OpenLoopReplay, Scripted
from bidex_meta.witness.scripts import scripts_of
from bidex_meta.witness.store import load_witness, witness_path
from bidex_meta.world.world import World
from bidex_meta.worlds import Worlds, WorldsConfig, open_worlds

_POLICIES = {
    "random": "uniform actions",
    "zero": "zero actions",
    "witness": "the witness of task 0, open loop",
    "script": "the script of the class, by the state of each step",
}


@dataclass(frozen=True)
class BaselineFlags:
    """Measure the two ends of the normalised score: what a policy that has learned nothing gets, and the best known.

    Example: bidex-meta baseline random --suite MT20 --out random.json

    The better of random and zero actions scores 0, the expert 100. An episode in which the physics breaks counts here
    with the worst finished one of its class, elsewhere with what is stored of random actions.
    """

    what: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="random|zero|witness|script")]
    """random: uniform actions; zero: the action 0, joints held in the middle of their range and bases at rest;
    witness: the actions that solve task 0 of a class, in all its tasks; script: hands that a script leads, which knows
    the whole state (eight classes have one)."""
    suite: str = "MT20"  # Suite whose train tasks are played.
    episodes: Few = 4  # Episodes of each task.
    seed: Seed = 0  # Seed of tasks, starts and actions.
    threads: Threads | None = None  # Threads of the physics; None: one per core.
    out: Path | None = None
    """JSON file that takes the figures, beside those it has of other classes; None: print them alone. `evaluate` reads
    assets/references/ of the installation, which is not written unless this names it."""
    json: JsonSwitch = False


def main(arguments: Sequence[str]) -> None:
    """Measure, print, and store if ``--out`` is given."""
    flags = parse(BaselineFlags, arguments, "baseline")
    what = known_name("baseline", flags.what, _POLICIES)
    if flags.out is not None:
        references.load_from(flags.out)
        check_writable(flags.out)
    worlds = open_worlds(WorldsConfig(suite=flags.suite, seed=flags.seed, threads=flags.threads))
    if not worlds.moving_bases:
        raise BidexError(f'References are of moving bases, but {flags.suite} has fixed ones. Write base = "moving".')
    if what == "script":
        found = _scripted(worlds, flags)
    else:
        found = _played(what, worlds, flags)
    numbers = found.to_json()["classes"]
    if flags.out is not None:
        stored = ("return", "return_interval", "success", "episodes", "unstable")
        made = {"policy": _POLICIES[what], "suite": portable(flags.suite), "seed": flags.seed}
        made |= {"versions": collect_versions()}
        classes = {name: {key: row[key] for key in stored} for name, row in numbers.items()}
        references.store(flags.out, classes, made)
    if flags.json:
        print(json.dumps(numbers, indent=2))
        return
    if flags.out is None:
        where = ""
    else:
        where = f", stored in {flags.out}"
    print_table(evaluation_table(f"{_POLICIES[what]} on {flags.suite}{where}", found))


def _played(what: str, worlds: Worlds, flags: BaselineFlags) -> Evaluation:
    world = worlds.world()
    names = world.task_names
    if what == "random":
        agent = RandomAgent(world.action_space, flags.seed)
    elif what == "zero":
        agent = ZeroAgent(world.action_space)
    else:
        witnesses = {name: load_witness(name) for name in names if witness_path(name).is_file()}
        agent = OpenLoopReplay(witnesses, list(names), world.task_id, world.single_action_space.shape[0])
        names = list(witnesses)
    found = evaluate(agent, world, flags.episodes, references={})
    world.close()
    return replace(found, classes={name: found.classes[name] for name in names})


def _scripted(worlds: Worlds, flags: BaselineFlags) -> Evaluation:
    """Evaluate the scripts of all classes that have one."""
    scripts = scripts_of(next(iter(worlds.task_classes().values())).rules)
    names = [name for name in worlds.task_classes() if name in scripts]
    if not names:
        raise BidexError(f"Expected a suite with a class that has a script ({', '.join(scripts)}), got {flags.suite}.")
    world = worlds.world()
    assert isinstance(world, World)
    found = evaluate(Scripted(world, names=names), world, flags.episodes, references={})
    world.close()
    return replace(found, classes={name: found.classes[name] for name in names})

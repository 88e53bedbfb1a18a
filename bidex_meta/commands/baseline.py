"""``bidex-meta baseline``: the references of the normalised score."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from bidex_meta.commands.parsing import Switch, parse
from bidex_meta.errors import BidexError, known_name
from bidex_meta.validation import Few, Seed, Threads
from bidex_meta.worlds import Worlds

if TYPE_CHECKING:
    from bidex_meta.agents import Agent
    from bidex_meta.evaluation.results import Evaluation

_POLICIES = {
    "random": "uniform actions",
    "zero": "zero actions",
    "witness": "the witness of task 0, open loop",
    "script": "the script of the class, led anew from each start",
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
    the whole state (seven classes have one)."""
    suite: str = "MT20"
    """Suite whose train tasks are played."""
    episodes: Few = 4
    """Episodes of each task."""
    seed: Seed = 0
    """Seed of tasks, starts and actions."""
    threads: Threads | None = None
    """Threads of the physics; None: one per core."""
    out: Path | None = None
    """JSON file that takes the figures, beside those it has of other classes; None: print them alone. `evaluate` reads
    assets/references/ of the installation, which is not written unless this names it."""
    json: Switch = False
    """Print JSON."""


def main(arguments: Sequence[str]) -> None:
    """Measure, print, and store where it was asked."""
    flags = parse(BaselineFlags, arguments, "baseline")
    what = known_name("baseline", flags.what, _POLICIES)
    if flags.out is not None:
        from bidex_meta.evaluation.references import load_from
        from bidex_meta.record.atomic import check_writable

        load_from(flags.out)
        check_writable(flags.out)
    source = Worlds.open({"suite": flags.suite, "seed": flags.seed, "threads": flags.threads})
    if not source.moving_bases:
        raise BidexError(f'References are of moving bases, but {flags.suite} has fixed ones. Write base = "moving".')
    found = _scripted(source, flags) if what == "script" else _played(what, source, flags)
    numbers = {name: result.to_json() for name, result in found.classes.items()}
    kept = ("return", "return_interval", "success", "episodes", "unstable")
    made = {"policy": _POLICIES[what], "suite": flags.suite, "seed": flags.seed}
    _store(flags.out, {n: {k: row[k] for k in kept} for n, row in numbers.items()}, made)
    if flags.json:
        print(json.dumps(numbers, indent=2))
        return
    from bidex_meta.commands.tables import evaluation_table, print_table

    stored = "" if flags.out is None else f", stored in {flags.out}"
    print_table(evaluation_table(f"{_POLICIES[what]} on {flags.suite}{stored}", found, None))


def _played(what: str, source: Worlds, flags: BaselineFlags) -> "Evaluation":
    from bidex_meta.evaluation.play import EVALUATION_SEED, evaluate

    world = source.world()
    agent, names = _agent(what, world, flags.seed)
    found = evaluate(agent, world, flags.episodes, seed=EVALUATION_SEED, references={})
    world.close()
    return replace(found, classes={name: found.classes[name] for name in names})


def _scripted(source: Worlds, flags: BaselineFlags) -> "Evaluation":
    """Each class that has a script on its own: alone it has the tasks that it has in suites."""
    from bidex_meta.evaluation.play import EVALUATION_SEED, evaluate
    from bidex_meta.evaluation.results import Evaluation
    from bidex_meta.witness.demonstrators import Scripted
    from bidex_meta.witness.scripts import SCRIPTS

    names = [name for name in source.task_classes() if name in SCRIPTS]
    if not names:
        raise BidexError(f"Expected a suite with a class that has a script ({', '.join(SCRIPTS)}), got {flags.suite}.")
    classes = {}
    for name in names:
        config = {"task": name, "base": "moving", "seed": flags.seed, "device": "cpu", "engine": "c"}
        world: Any = Worlds.open(config | {"threads": flags.threads}).world()
        played = evaluate(Scripted(world), world, flags.episodes, seed=EVALUATION_SEED, references={})
        classes |= played.classes
        world.close()
    return Evaluation(classes, flags.episodes)


def _agent(what: str, world: Any, seed: int) -> tuple["Agent", list[str]]:
    """The policy, and the classes that it can play."""
    from bidex_meta.evaluation.play import RandomAgent, ZeroAgent
    from bidex_meta.witness.demonstrators import OpenLoopReplay
    from bidex_meta.witness.store import load_witness, witness_path

    names = list(world.task_names)
    if what == "random":
        return RandomAgent(world.action_space, seed), names
    if what == "zero":
        return ZeroAgent(world.action_space), names
    witnesses = {name: load_witness(name) for name in names if witness_path(name).is_file()}
    agent = OpenLoopReplay(witnesses, names, world.task_id, world.single_action_space.shape[0])
    return agent, list(witnesses)


def _store(out: Path | None, classes: dict[str, dict[str, Any]], made: dict[str, Any]) -> None:
    from bidex_meta.evaluation import references
    from bidex_meta.record.versions import collect_versions

    if out is not None:
        references.store(out, classes, made | {"versions": collect_versions()})

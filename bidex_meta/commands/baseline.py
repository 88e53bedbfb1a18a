"""``bidex-meta baseline``: the references of the normalised score."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from bidex_meta.commands.parsing import Switch, parse
from bidex_meta.errors import BidexError, known_name
from bidex_meta.sources import Source

_POLICIES = {"random": "uniform actions", "zero": "zero actions"}


@dataclass(frozen=True)
class BaselineFlags:
    """Measure the two ends of the normalised score: what a policy that has learned nothing gets, and the best known.

    Example: bidex-meta baseline random --suite MT20 --out random.json

    The better of random and zero actions scores 0, the expert 100. An episode in which the physics breaks counts here
    with the worst finished one of its class, elsewhere with what is stored of random actions.
    """

    what: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="random|zero|expert")]
    """random: uniform actions; zero: the action 0, joints held in the middle of their range and bases at rest;
    expert: per class the best of its witness and of the runs given."""
    suite: str = "MT20"
    """Suite whose train tasks are played."""
    episodes: int = 4
    """Episodes of each task."""
    seed: int = 0
    """Seed of tasks, starts and actions."""
    threads: int | None = None
    """Threads of the physics; None: one per core."""
    runs: tuple[Path, ...] = ()
    """expert: trained policies: run folders, or files of results/data/."""
    out: Path | None = None
    """JSON file that takes the figures, beside those it has of other classes; None: print them alone. `evaluate` reads
    assets/references/ of the installation, which is not written unless this names it."""
    json: Switch = False
    """Print JSON."""


def main(arguments: Sequence[str]) -> None:
    """Measure, print, and store where it was asked."""
    flags = parse(BaselineFlags, arguments, "baseline")
    what = known_name("baseline", flags.what, [*_POLICIES, "expert"])
    if flags.out is not None:
        from bidex_meta.evaluation.references import load_from
        from bidex_meta.record.atomic import check_writable

        load_from(flags.out)
        check_writable(flags.out)
    if what == "expert":
        _expert(flags)
    else:
        _measure(what, flags)


def _expert(flags: BaselineFlags) -> None:
    from bidex_meta.commands.experts import best_known
    from bidex_meta.commands.tables import plain_table, print_table

    known = best_known(Source.open({"suite": flags.suite}).task_classes(), flags.runs, flags.threads)
    _store(flags.out, known, {})
    if flags.json:
        print(json.dumps(known, indent=2))
        return
    print_table(plain_table(["class", "return", "source"], [[n, *row.values()] for n, row in known.items()]))


def _measure(what: str, flags: BaselineFlags) -> None:
    from bidex_meta.evaluation.play import EVALUATION_SEED, evaluate
    from bidex_meta.evaluation.untrained import RandomAgent, ZeroAgent

    source = Source.open({"suite": flags.suite, "seed": flags.seed, "threads": flags.threads})
    if not source.moving_bases:
        raise BidexError(f'References are of moving bases, but {flags.suite} has fixed ones. Write base = "moving".')
    world = source.world()
    agent = RandomAgent(world.action_space, flags.seed) if what == "random" else ZeroAgent(world.action_space)
    found = evaluate(agent, world, flags.episodes, seed=EVALUATION_SEED)
    world.close()
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


def _store(out: Path | None, classes: dict[str, dict[str, Any]], made: dict[str, Any]) -> None:
    from bidex_meta.evaluation import references
    from bidex_meta.record.versions import collect_versions

    if out is not None:
        references.store(out, classes, made | {"versions": collect_versions()})

"""``bidex-meta baseline``: measure the reference returns, which define the score of version 1."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from bidex_meta.cli.parsing import JsonSwitch, parse
from bidex_meta.cli.tables import evaluation_table, print_table
from bidex_meta.errors import known_name
from bidex_meta.experiments.baselines import POLICIES, baseline
from bidex_meta.utils.validation import Few, Seed, Threads


@dataclass(frozen=True)
class BaselineFlags:
    """Measure a reference return: the return of an untrained policy or of a known solution.

    Example: bidex-meta baseline random --suite MT20 --out random.json

    In version 1 the score is 0 at the return of random or of zero actions, whichever is better. It is 100 at the return
    of the best known policy, the expert. In version 2 it needs no references.

    An episode in which the physics breaks gets the return of the worst finished episode of its class in this command,
    and the stored return of random actions in other commands.
    """

    what: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="random|zero|witness|script")]
    """Policy to measure. random: uniform actions; zero: the action 0, which holds joints in the middle of their range
    and bases at rest; witness: the actions that solve task 0 of a class, played in all its tasks; script: a
    hand-written controller that sees the whole state (eight classes have one, nineteen in version 2)."""
    suite: str = "MT20"  # Suite whose train tasks are played.
    episodes: Few = 4  # Episodes of each task.
    seed: Seed = 0  # Seed that draws tasks, start states and actions.
    threads: Threads | None = None  # CPU threads for the physics; None: one per core.
    out: Path | None = None
    """JSON file to which the results are added; it keeps its results of other classes. None: only print the results.
    `evaluate` reads the files in assets/references/ of the installation; they change only if this flag names one of
    them."""
    json: JsonSwitch = False


def main(arguments: Sequence[str]) -> None:
    """Measure the policy's returns, print them, and store them if ``--out`` is given."""
    flags = parse(BaselineFlags, arguments, "baseline")
    policy = known_name("baseline", flags.what, POLICIES)
    found = baseline(
        policy, flags.suite, episodes=flags.episodes, seed=flags.seed, threads=flags.threads, out=flags.out
    )
    if flags.json:
        print(json.dumps(found.to_json()["classes"], indent=2))
        return
    title = f"{POLICIES[policy]} on {flags.suite}"
    if flags.out is not None:
        title += f", stored in {flags.out}"
    print_table(evaluation_table(title, found))

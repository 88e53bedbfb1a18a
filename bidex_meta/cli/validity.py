"""``bidex-meta validity``: measure whether a suite's tasks must be identified to be solved, and whether they can be."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from bidex_meta.cli.parsing import JsonSwitch, parse
from bidex_meta.cli.tables import Json, plain_table, print_table
from bidex_meta.experiments.suite_validity import validity_rows
from bidex_meta.runs.atomic import check_writable, write_json
from bidex_meta.runs.versions import collect_versions
from bidex_meta.utils.files import portable
from bidex_meta.utils.validation import Seed, Threads
from bidex_meta.worlds import WorldsConfig, open_worlds


@dataclass(frozen=True)
class ValidityFlags:
    """Measure whether a policy must identify a suite's tasks to solve them, and whether rewards identify the tasks.

    Example: bidex-meta validity --suite ML20-v2 --out validity.json

    The table has five measures per class:

    (1) the highest success on unseen tasks that a policy can reach without knowing what a task hides;

    (2) the share of first observations that identify the task; chance is one over the number of tasks;

    (3) the share of exploring episodes whose rewards identify the hidden values, for the best of three ways to explore:
    random actions, a noisy witness (recorded actions that solve one task), and a noisy script that was given a wrong
    goal;

    (4) the success of untrained policies, of the witness, and of scripts and runs that know the task;

    (5) the agreement of return and success over the episodes of all these policies.
    """

    suite: str = "ML20-v2"
    """Suite to measure: a name or a suite file. The train tasks of its train classes are measured, and the test tasks
    of its test classes. If a class is in both splits, only its test tasks are measured."""
    policy: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction] = ()
    """Folder of a run whose policy knows the tasks; the run must have the rules of this suite, and its policy may know
    only some of the classes. Repeat the flag for several runs."""
    seed: Seed = 0
    """Seed that draws tasks, start states and actions."""
    threads: Threads | None = None
    """CPU threads for the physics; None: one per core."""
    out: Path | None = None
    """JSON file to write the table to."""
    json: JsonSwitch = False


def main(arguments: Sequence[str]) -> None:
    """Compute the measures, print them, and write them to a file if ``--out`` is given."""
    flags = parse(ValidityFlags, arguments, "validity")
    if flags.out is not None:
        check_writable(flags.out)
    worlds = open_worlds(WorldsConfig(suite=flags.suite, seed=flags.seed, threads=flags.threads))
    rows = validity_rows(worlds, flags.policy)
    made = {"suite": portable(flags.suite), "seed": flags.seed, "versions": collect_versions()}
    if flags.out is not None:
        write_json(flags.out, made | {"classes": rows})
    if flags.json:
        print(json.dumps(rows, indent=2))
        return
    print_table(
        plain_table(["class", "hidden", *_SHARES, "aligned"], [_cells(name, row) for name, row in rows.items()])
    )


_SHARES = ("blind", "named", "identified", "uniform", "zero", "held", "witness", "solved")


def _cells(name: str, row: Json) -> list[str]:
    shares = ["" if row[key] is None else f"{100 * row[key]:.1f} %" for key in _SHARES]
    shares[_SHARES.index("named")] += f" ({100 * row['chance']:.0f} %), R² {row['explained']:.2f}"
    if row["alignment"] is None:
        rank = ""
    else:
        rank = f"{row['alignment']['rank']:.2f}"
    return [name, ", ".join(row["hidden"]) or "nothing", *shares, rank]

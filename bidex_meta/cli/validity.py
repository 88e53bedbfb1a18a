"""``bidex-meta validity``: measure if there is something to learn about the tasks of a suite."""

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
    """Measure whether there is something to learn about the tasks of a suite.

    Example: bidex-meta validity --suite ML20-v2 --out validity.json

    For each class: the success on unseen tasks that a policy can have at best without knowing what a task hides; how
    often a first observation names the task (chance: one over the number of tasks); how often the rewards of one
    exploring episode (rough actions, a witness's or a misled script's with noise) identify the hidden parts; the
    success of policies that have learned nothing, and of scripts and runs that know the task; and whether return and
    success agree over all their episodes.
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
    shares[_SHARES.index("named")] += f" ({100 * row['chance']:.0f} %)"
    if row["alignment"] is None:
        rank = ""
    else:
        rank = f"{row['alignment']['rank']:.2f}"
    return [name, ", ".join(row["hidden"]) or "nothing", *shares, rank]

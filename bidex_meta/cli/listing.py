"""``bidex-meta list``: list suites, tasks, algos or objects, or the values that tasks hide from the policy."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from bidex_meta.cli.parsing import JsonSwitch, parse
from bidex_meta.cli.tables import print_rows
from bidex_meta.errors import known_name
from bidex_meta.experiments.catalogue import algo_rows, hidden_rows, object_rows, task_rows
from bidex_meta.worlds import listed


@dataclass(frozen=True)
class ListFlags:
    """List the available suites, tasks, algos or objects, or the values that tasks hide from the policy.

    Example: bidex-meta list tasks --json
    """

    what: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="suites|tasks|hidden|algos|objects")]
    """Kind of entries: suites, tasks, hidden (parts that tasks of version 2 hide, with ranges and tolerances in metres
    and rad), algos, or objects (what the throwing classes can throw)."""
    json: JsonSwitch = False


def main(arguments: Sequence[str]) -> None:
    """Print a table or JSON, one row per entry."""
    flags = parse(ListFlags, arguments, "list")
    kinds = {"suites": listed, "tasks": task_rows, "hidden": hidden_rows, "algos": algo_rows, "objects": object_rows}
    rows = kinds[known_name("list", flags.what, kinds)]()
    print_rows(rows, flags.json, spare=("test classes", "train classes", "presets"))

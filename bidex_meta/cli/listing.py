"""``bidex-meta list``: what there is."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from bidex_meta.cli.learners import ALGOS, learner_kind
from bidex_meta.cli.parsing import Switch, parse
from bidex_meta.cli.tables import plain_table, print_table
from bidex_meta.errors import known_name
from bidex_meta.tasks import registry
from bidex_meta.worlds import listed


@dataclass(frozen=True)
class ListFlags:
    """The suites, tasks, algos or objects there are.

    Example: bidex-meta list tasks --json
    """

    what: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="suites|tasks|algos|objects")]
    """suites, tasks, algos or objects (what the throwing classes throw)."""
    json: Switch = False
    """Print JSON."""


def main(arguments: Sequence[str]) -> None:
    """Print a table or JSON, one row for each."""
    flags = parse(ListFlags, arguments, "list")
    kinds: dict[str, Callable[[], list[dict[str, Any]]]]
    kinds = {"suites": listed, "tasks": _tasks, "algos": _algos, "objects": _objects}
    rows = kinds[known_name("list", flags.what, kinds)]()
    if flags.json:
        print(json.dumps(rows, indent=2))
        return
    columns = list(rows[0]) if rows else ["name"]
    print_table(plain_table([column.replace("_", " ") for column in columns], [_cells(row) for row in rows]))


def _tasks() -> list[dict[str, Any]]:
    tasks = [(name, registry.get(name)) for name in registry.names()]
    return [
        {
            "name": name,
            "observation": task.observation_size,
            "action": task.action_size,
            "episode_steps": task.episode_steps,
            "summary": task.summary,
        }
        for name, task in tasks
    ]


def _algos() -> list[dict[str, Any]]:
    rows = []
    for name in ALGOS:
        kind = learner_kind(name)
        summary = (kind.make.__doc__ or "").strip().splitlines()[0]
        rows.append({"name": name, "presets": list(kind.presets), "summary": summary})
    return rows


def _objects() -> list[dict[str, Any]]:
    from bidex_meta.tasks.objects.held import held_object, shelf

    # The egg's figures: docs/figures.md, objects.
    rows: list[dict[str, Any]] = [{"name": "egg", "mass_g": 75.4, "box_mm": "60 x 60 x 80", "geoms": 1}]
    for name in shelf():
        if found := held_object(name):
            box = " x ".join(f"{1000 * (high - low):.0f}" for low, high in zip(found.low, found.high, strict=True))
            rows.append({"name": name, "mass_g": round(1000 * found.mass, 1), "box_mm": box, "geoms": found.geoms})
    return rows


def _cells(row: dict[str, Any]) -> list[Any]:
    return [", ".join(value) if isinstance(value, list) else value for value in row.values()]

"""``bidex-meta compare``: several runs beside each other, intervals over seeds."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bidex_meta.cli.parsing import RunPaths, Switch, named_runs, parse
from bidex_meta.cli.tables import class_table, group_table, plain_table, print_table
from bidex_meta.evaluation.comparison import Group, estimates, iqm, read_groups, score_over, success_over
from bidex_meta.runs import plots


@dataclass(frozen=True)
class CompareFlags:
    """Compare evaluated runs; those that differ in the seed alone are one group, measured against the first group.

    Example: bidex-meta compare runs/MT4/mtppo/* runs/MT4/mttrpo/*
    """

    runs: RunPaths
    """Run folders, or files of results/data/."""
    json: Switch = False
    """Print JSON."""
    out: Path | None = None
    """Also draw success and score of the groups, with their intervals, into this picture (.png, .svg, .pdf)."""


def main(arguments: Sequence[str]) -> None:
    """Read, compare, print.

    Raises:
        BidexError: No run is named, or one is not a run folder or not evaluated.
    """
    flags = parse(CompareFlags, arguments, "compare")
    groups = read_groups(named_runs(flags.runs, "compare"))
    if flags.out is not None:
        plots.save(plots.draw_comparison(estimates(groups)), flags.out)
    if flags.json:
        print(json.dumps([_row(group, groups[0]) for group in groups], indent=2))
        return
    print_table(plain_table(*group_table(groups)))
    print_table(plain_table(*class_table(groups)))
    print("IQM over seeds and classes [95 % bootstrap over seeds]. An interval that holds 0 is no difference.")


def _row(group: Group, first: Group) -> dict[str, Any]:
    row: dict[str, Any] = {
        "group": group.label, "seeds": group.seeds, "steps": group.steps, "steps_range": list(group.steps_range),
        "hours": round(group.hours, 3),
    }  # fmt: skip
    for name, own, over in (
        ("success", group.success, success_over(group, first)),
        ("score", group.scores, score_over(group, first)),
    ):
        row[f"{name}_iqm"] = None if own is None else vars(iqm(own))
        row[f"{name}_over_first"] = None if over is None else vars(over)
    row["classes"] = {
        name: {"success": group.success[:, i].tolist(), "return": group.returns[:, i].tolist()}
        for i, name in enumerate(group.classes)
    }
    return row

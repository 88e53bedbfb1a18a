"""``bidex-meta compare``: compare several runs, with intervals over seeds."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bidex_meta.cli.parsing import JsonSwitch, RunPaths, parse
from bidex_meta.cli.plot import named_runs
from bidex_meta.cli.tables import NONE, Json, plain_table, print_table
from bidex_meta.evaluation.comparison import Group, estimates, read_groups, score_over, success_over
from bidex_meta.evaluation.statistics import iqm_over_seeds
from bidex_meta.runs import plots
from bidex_meta.runs.provenance import release_of
from bidex_meta.training.launch import say


@dataclass(frozen=True)
class CompareFlags:
    """Compare evaluated runs; those that differ in the seed alone are one group, measured against the first group.

    Example: bidex-meta compare runs/MT4/mtppo/* runs/MT4/mttrpo/*
    """

    runs: RunPaths  # Run folders, or studies of results/data: FILE or FILE:RUN.
    json: JsonSwitch = False
    out: Path | None = None  # Also draw the groups' success and score, with intervals, into this .png, .svg or .pdf.


def main(arguments: Sequence[str]) -> None:
    """Read, compare, print."""
    flags = parse(CompareFlags, arguments, "compare")
    runs = named_runs(flags.runs, "compare")
    groups = read_groups(runs)
    for group in groups:
        releases = {release_of(run) for run in runs if run.path in group.paths} - {None}
        if len(releases) > 1:
            say(f"{group.label}: its runs were made with bidex-meta {', '.join(sorted(map(str, releases)))}.")
    if flags.out is not None:
        plots.save(plots.draw_comparison(estimates(groups)), flags.out)
    if flags.json:
        print(json.dumps([_row(group, groups[0]) for group in groups], indent=2))
        return
    print_table(plain_table(*group_table(groups), spare=("hours", "steps")))
    print_table(plain_table(*class_table(groups)))
    print("IQM over seeds and classes [95 % bootstrap over seeds]. An interval that holds 0 is no difference.")


def _row(group: Group, first: Group) -> Json:
    row: Json = {
        "group": group.label, "seeds": group.seeds, "steps": group.steps, "steps_range": list(group.steps_range),
        "hours": round(group.hours, 3),
    }  # fmt: skip
    measures = ("success", group.success, success_over(group, first)), ("score", group.scores, score_over(group, first))
    for name, own, over in measures:
        row[f"{name}_iqm"] = None if own is None else vars(iqm_over_seeds(own))
        row[f"{name}_over_first"] = None if over is None else vars(over)
    row["classes"] = {
        name: {"success": group.success[:, i].tolist(), "return": group.returns[:, i].tolist()}
        for i, name in enumerate(group.classes)
    }
    return row


def group_table(groups: Sequence[Group]) -> tuple[list[str], list[list[str]]]:
    """Return columns and rows of a table with one row per group of runs, each compared with the first group."""
    columns = ["group", "seeds", "steps", "hours", "success, IQM (%)", "score, IQM"]
    rows = []
    for group in groups:
        if group.scores is None:
            score = None
        else:
            score = iqm_over_seeds(group.scores)
        measures = (iqm_over_seeds(group.success), 100.0, ".1f"), (score, 1.0, ".1f")
        over = (success_over(group, groups[0]), 100.0, "+.1f"), (score_over(group, groups[0]), 1.0, "+.1f")
        cells = [NONE if each is None else each.text(factor, form=form) for each, factor, form in (*measures, *over)]
        seeds = f"{len(group.seeds)} ({', '.join(map(str, group.seeds))})"
        rows.append([group.label, seeds, group.steps_text(), f"{group.hours:.2f}", *cells])
    return [*columns, "success over the first", "score over the first"], rows


def class_table(groups: Sequence[Group]) -> tuple[list[str], list[list[str]]]:
    """Return columns and rows of a table with one row per class and group: mean over seeds, and range of seeds."""
    rows = []
    for name in dict.fromkeys(name for group in groups for name in group.classes):
        for group in groups:
            if name not in group.classes:
                continue
            place = list(group.classes).index(name)
            success = 100.0 * group.success[:, place]
            returns = group.returns[:, place]
            rows.append([name, group.label, _spread(success, ".1f"), _spread(returns, ".4g")])
    return ["class", "group", "success, mean (%) [seeds]", "return, mean [seeds]"], rows


def _spread(values: np.ndarray, form: str) -> str:
    """Format the mean, the least and the largest of values."""
    return f"{values.mean():{form}} [{values.min():{form}} to {values.max():{form}}]"

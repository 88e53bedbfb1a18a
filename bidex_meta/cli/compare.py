"""``bidex-meta compare``: compare several runs, with intervals over seeds."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidex_meta.cli.parsing import JsonSwitch, RunPaths, parse
from bidex_meta.cli.plot import named_runs
from bidex_meta.cli.tables import plain_table, print_table
from bidex_meta.evaluation.comparison import estimates, read_groups
from bidex_meta.experiments.comparing import class_table, group_row, group_table, setting_lines
from bidex_meta.runs import plots
from bidex_meta.runs.provenance import release_of
from bidex_meta.training.launch import say


@dataclass(frozen=True)
class CompareFlags:
    """Compare groups of evaluated runs with the first group; runs that differ only in the seed form a group.

    Example: bidex-meta compare runs/MT4/mtppo/* runs/MT4/mttrpo/*
    """

    runs: RunPaths  # Run folders, or studies in results/data: FILE for all runs of a study, FILE:RUN for one.
    json: JsonSwitch = False
    out: Path | None = None
    """Also draw success and score of the groups, with intervals, into this .png, .svg or .pdf file."""


def main(arguments: Sequence[str]) -> None:
    """Read the runs, compare their groups, and print the comparison."""
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
        print(json.dumps([group_row(group, groups[0]) for group in groups], indent=2))
        return
    print_table(plain_table(*group_table(groups), spare=("hours", "steps")))
    print_table(plain_table(*class_table(groups)))
    for line in setting_lines(groups):
        print(line)
    print("IQM over seeds and classes [95 % bootstrap over seeds]. An interval that contains 0 shows no difference.")

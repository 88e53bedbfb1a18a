"""``bidex-meta report``: write one HTML page about runs.

The file contains its pictures and films, so that the page needs no network.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidex_meta.cli.parsing import RunPaths, parse
from bidex_meta.cli.plot import named_runs, output
from bidex_meta.experiments.report_page import render
from bidex_meta.runs.atomic import write_atomic


@dataclass(frozen=True)
class ReportFlags:
    """Write an HTML page about runs: final table, curves, adaptation, throughput, differences of configs, films.

    Example: bidex-meta report runs/MT4/mtppo/* runs/MT4/mttrpo/* --out mt4.html

    The page needs no network and no other file. Runs that differ only in the seed share one line, with intervals.
    """

    runs: RunPaths  # Run folders, or studies in results/data: FILE for all runs of a study, FILE:RUN for one.
    out: Path | None = None
    """HTML file to write. None: report.html, in the run's folder or, for several runs, in the current folder."""


def main(arguments: Sequence[str]) -> None:
    """Write the page and print its path."""
    flags = parse(ReportFlags, arguments, "report")
    runs = named_runs(flags.runs, "report")
    out = output(flags.out, runs, "report.html")
    text = render(runs)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(out, lambda file: file.write(text.encode()))
    print(out)

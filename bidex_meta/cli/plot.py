"""``bidex-meta plot``: draw learning curves."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from bidex_meta.cli.parsing import RunPaths, Switch, parse
from bidex_meta.errors import BidexError
from bidex_meta.experiments.plotting import plot
from bidex_meta.runs import RunFolder, plots
from bidex_meta.runs.atomic import check_writable, refuse_links
from bidex_meta.runs.evaluations import read_evaluation
from bidex_meta.runs.stored import StoredRun, open_runs


@dataclass(frozen=True)
class PlotFlags:
    """Draw return and success of every task against training steps, or against shots of adaptation.

    Example: bidex-meta plot runs/MT4/mtppo/* --out curves.png

    Runs that differ only in the seed share one line, with the 95 % bootstrap interval over runs.
    """

    runs: RunPaths  # Run folders, or studies in results/data: FILE for all runs of a study, FILE:RUN for one.
    adaptation: Switch = False
    """Plot against shots of adaptation, from the meta-test in the evaluation.json of one run."""
    evaluation: Path | None = None
    """With --adaptation: output of `bidex-meta evaluate RUN --shots K --json` to plot instead of the run's
    evaluation.json."""
    out: Path | None = None
    """Picture to write. None: curves.png or adaptation.png, in the run's folder or, for several runs, in the current
    folder."""


def main(arguments: Sequence[str]) -> None:
    """Draw the curves and print the picture's path."""
    flags = parse(PlotFlags, arguments, "plot")
    runs = named_runs(flags.runs, "plot")
    if not (flags.adaptation or flags.evaluation):
        out = output(flags.out, runs, "curves.png")
        plot(runs, out)
    elif len(runs) > 1:
        raise BidexError(f"--adaptation draws a single run, got {len(runs)}. bidex-meta report shows all.")
    else:
        out = output(flags.out, runs, "adaptation.png")
        run = runs[0]
        if flags.evaluation is None:
            source = run.evaluation_path
            evaluation = run.evaluation()
        else:
            source = flags.evaluation
            evaluation = read_evaluation(source, f"bidex-meta evaluate {run.path} --shots 3 --json > {source}")
        plots.save(plots.draw_adaptation(evaluation, source, run.goal), out)
    print(out)


def named_runs(paths: Sequence[Path], command: str) -> list[RunFolder | StoredRun]:
    """Open the runs that a command was given. Raises BidexError if there is no run, or a path is not a run."""
    if not paths:
        raise BidexError(f"Name the run folders: bidex-meta {command} RUN...")
    return list(chain.from_iterable(map(open_runs, paths)))


def output(asked: Path | None, runs: Sequence[RunFolder | StoredRun], name: str) -> Path:
    """Return the path to write, after a check that it can be written.

    The path is ``asked``. If that is None, it is ``name`` in the run's folder or, for several runs, in the working
    folder.
    """
    out = asked or (runs[0].path if len(runs) == 1 and runs[0].path.is_dir() else Path()) / name
    if asked is None:
        refuse_links(out)
    check_writable(out)
    return out

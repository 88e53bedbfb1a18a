"""Learning curves of runs as a picture."""

from collections.abc import Sequence
from pathlib import Path

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.comparison import read_histories
from bidex_meta.runs import RunFolder, plots
from bidex_meta.runs.atomic import check_writable
from bidex_meta.runs.stored import StoredRun, open_runs
from bidex_meta.utils.arguments import checked_arguments


@checked_arguments
def plot(runs: Sequence[RunFolder | StoredRun | str | Path], out: str | Path) -> Path:
    """Draw return and success of every task against environment steps into ``out``, and return its path.

    Runs that differ only in the seed are one line, with the 95 % bootstrap interval over runs. The suffix of ``out``
    decides the format (``.png``, ``.svg``, ``.pdf``). Raises BidexError if a run has no metrics or ``out`` cannot be
    written.
    """
    opened: list[RunFolder | StoredRun] = []
    for run in runs:
        opened += [run] if isinstance(run, RunFolder | StoredRun) else open_runs(Path(run))
    if not opened:
        raise BidexError("Expected at least one run to plot, got none.")
    path = Path(out)
    check_writable(path)
    histories = read_histories(opened)
    plots.save(plots.draw_learning([(history.label, history.curves) for history in histories]), path)
    return path

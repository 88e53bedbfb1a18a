"""Learning curves of runs as a picture."""

from collections.abc import Sequence
from pathlib import Path

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.comparison import read_histories
from bidex_meta.experiments.learners import learner_class
from bidex_meta.runs import RunFolder, plots
from bidex_meta.runs.atomic import check_writable
from bidex_meta.runs.stored import Run, StoredRun, open_runs
from bidex_meta.training.learner import Capability
from bidex_meta.utils.arguments import checked_arguments


@checked_arguments
def plot(runs: Sequence[RunFolder | StoredRun | str | Path], out: str | Path) -> Path:
    """Draw return and success of every task against training steps into ``out``, and return its path.

    Runs that differ only in the seed are one line, with the 95 % bootstrap interval over runs. The suffix of ``out``
    decides the format (``.png``, ``.svg``, ``.pdf``). Raises BidexError if a run has no metrics or ``out`` cannot be
    written.
    """
    opened: list[Run] = []
    for run in runs:
        opened += [run] if isinstance(run, RunFolder | StoredRun) else open_runs(Path(run))
    if not opened:
        raise BidexError("Expected at least one run to plot, got none.")
    path = Path(out)
    check_writable(path)
    histories = read_histories(opened)
    plots.save(plots.draw_learning([(each.label, each.curves) for each in histories], steps_of(opened)), path)
    return path


def steps_of(runs: Sequence[Run]) -> str:
    """Say what a training step of some runs is: learners on data sets count gradient updates."""
    kinds = {is_offline(run) for run in runs}
    if kinds == {True}:
        return "gradient updates"
    if True in kinds:
        return f"{plots.STEPS}, or gradient updates on data sets"
    return plots.STEPS


def is_offline(run: Run) -> bool:
    """Return whether a run's learner never steps the world; False if the learner is not installed here."""
    try:
        return Capability.OFFLINE in learner_class(run.config().algo).capabilities
    except BidexError:
        return False

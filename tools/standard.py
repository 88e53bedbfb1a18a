"""The check that an evaluation can be compared with others: it is on train tasks, and nothing is randomised."""

from bidex_meta.errors import BidexError
from bidex_meta.runs.evaluations import Evaluated
from bidex_meta.runs.stored import Run


def check_standard(run: Run, evaluation: Evaluated) -> None:
    """Raise BidexError if a run's evaluation is on other tasks than the train tasks, or in randomised worlds."""
    if evaluation.split != "train":
        raise BidexError(
            f"{run.evaluation_path}: expected an evaluation of train tasks, got {evaluation.split} tasks. Write it "
            f"again: {run.again}"
        )
    if evaluation.randomisation is not None:
        raise BidexError(
            f"{run.evaluation_path}: expected an evaluation without randomisation, got one with --randomisation. "
            f"Write it again: {run.again}"
        )

"""``bidex-meta record``: record data sets of whole episodes, for learners that train offline."""

from collections.abc import Sequence
from dataclasses import dataclass

from bidex_meta.cli.parsing import Switch, parse
from bidex_meta.experiments.recording import RecordConfig, record, say_estimate


@dataclass(frozen=True)
class RecordFlags(RecordConfig):
    """Record a data set: whole episodes of a policy, as Minari and HDF5.

    Example: bidex-meta record random --task CatchUnderarm

    If the command is killed or interrupted, run it again: it continues and ends with the same data.
    """

    estimate: Switch = False  # Print the maximum disk space and memory that the recording takes, then exit.


def main(arguments: Sequence[str]) -> None:
    """Record a data set, or resume a recording."""
    flags = parse(RecordFlags, arguments, "record")
    if flags.estimate:
        say_estimate(flags)
    else:
        record(flags)

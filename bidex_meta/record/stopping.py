"""What ends a run before its steps are done: time, or a return, success or score that its metrics reach.

Its config and the last line of its metrics say so, whoever asks later: nothing else need be kept of it.
"""

from collections.abc import Mapping, Sequence
from typing import Any

ENDS = ("stop_at_return", "stop_at_success", "stop_at_score")
"""Entries of a run's config that end it early; None where they do not, and missing in older ones."""


def enough(config: Mapping[str, Any], row: Mapping[str, Any]) -> str | None:
    """By what a line of metrics ends its run (one of ``ENDS``).

    Args:
        config: The run's; an older one knows no such ends.
        row: The line, tag to number; None where a number was not finite.

    Returns:
        The tag that has reached its number; None where the run goes on.
    """
    place = "Train" if config.get("evaluate_every") is None else "Eval"
    tags = (f"{place}/mean_return", f"{place}/success_rate", "Eval/score")
    for tag, value in zip(tags, map(config.get, ENDS), strict=True):
        found = row.get(tag)
        if value is not None and found is not None and found >= value:
            return tag
    return None


def goal(config: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> int:
    """Steps that a run trains for: those it made where time or its metrics ended it, else those it was asked for.

    Args:
        config: The run's.
        rows: Its logged lines, at least the last.
    """
    last = rows[-1] if rows else {"step": 0}
    return last["step"] if config.get("minutes") is not None or enough(config, last) else config["steps"]

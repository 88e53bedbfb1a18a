"""What ends a run before its steps are done: time, or a return or score that its metrics reach.

Its config and the last line of its metrics say so, whoever asks later: nothing else need be kept of it.
"""

from collections.abc import Mapping, Sequence
from typing import Any


def enough(config: Mapping[str, Any], row: Mapping[str, Any]) -> str | None:
    """By what a line of metrics ends its run (``--stop-at-return``, ``--stop-at-score``).

    Args:
        config: The run's; an older one knows no such ends.
        row: The line, tag to number; None where a number was not finite.

    Returns:
        The tag that has reached its number; None where the run goes on.
    """
    evaluated = config.get("evaluate_every") is not None
    wanted = {f"{'Eval' if evaluated else 'Train'}/mean_return": config.get("stop_at_return")}
    wanted["Eval/score"] = config.get("stop_at_score")
    for tag, value in wanted.items():
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

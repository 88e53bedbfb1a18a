"""Comparison of a repeated evaluation with the recorded one, class by class."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.results import MANY_TASKS
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.evaluations import ClassSummary, Interval

EQUAL = "equal"
WITHIN = "within"
DIFFERS = "differs"
_RATES = ("success", "success_once", "success_at_end")
_BITS = (*_RATES, "mean_return", "score", "length", "episodes", "tasks", "unstable", "solved")
_MEASURES = 2  # success and return; the limits of the other rates are too wide to be exceeded by chance


@dataclass(frozen=True)
class Agreement:
    """Comparison of one class's results in a recorded evaluation and in its repetition."""

    name: str  # name of the class; for a meta-test, with split and shot
    outcome: str
    """``equal``: bit for bit; ``within``: rates of success and the return differ no more than their intervals allow, or
    the score alone differs, whose references may have changed; ``differs``: otherwise."""
    recorded: ClassSummary
    again: ClassSummary

    def to_json(self) -> Json:
        """Return the outcome of the comparison, and success and return of both evaluations, ready for JSON."""
        return {
            "outcome": self.outcome,
            "success": [self.recorded.success, self.again.success],
            "return": [self.recorded.mean_return, self.again.mean_return],
            "score": [self.recorded.score, self.again.score],
        }


def agreements(recorded: Mapping[str, ClassSummary], again: Mapping[str, ClassSummary]) -> list[Agreement]:
    """Compare, for each class, two evaluations of one policy on the same tasks and start states.

    At worst, the two evaluations are independent samples. Their means may therefore differ by sqrt(a² + b²), where a
    and b are the half-widths of their 95 % intervals. This limit is widened (Bonferroni) so that nominally only one in
    twenty correct repetitions exceeds it in any measure of any class. We simulated twenty classes: the rate was one in
    eighteen with 200 episodes per class, one in fourteen with 60, and one in seven with 20. Raises BidexError if the
    two evaluations have different classes.
    """
    if set(recorded) != set(again):
        raise BidexError(
            f"Expected the recorded evaluation to be of {', '.join(again)}, got {', '.join(recorded)}. Evaluate again."
        )
    normal = NormalDist().inv_cdf
    wider = normal(1 - 0.025 / (_MEASURES * len(recorded))) / normal(0.975)
    return [Agreement(name, _outcome(row, again[name], wider), row, again[name]) for name, row in recorded.items()]


def _outcome(recorded: ClassSummary, again: ClassSummary, wider: float) -> str:
    if all(getattr(recorded, name) in (None, getattr(again, name)) for name in _BITS):
        return EQUAL
    if recorded.episodes not in (None, again.episodes):
        return DIFFERS
    if again.tasks is not None and again.tasks >= MANY_TASKS:
        count = again.tasks
    else:
        count = again.episodes or 1
    # The interval of a success rate follows from the rate. The limit is 1.5 times as wide.
    half = min(_half(recorded.success_interval), 1.5 * _half_of_rate(recorded.success, count))
    gap = abs(recorded.success - again.success)
    if gap > _rounding(recorded.success) + wider * math.hypot(_half(again.success_interval), half):
        return DIFFERS
    for then, now in ((recorded.success_once, again.success_once), (recorded.success_at_end, again.success_at_end)):
        if then is None or now is None:
            continue
        half = math.hypot(_half_of_rate(then, count), _half_of_rate(now, count))
        if abs(then - now) > _rounding(then) + wider * 1.5 * half:
            return DIFFERS
    from scipy.stats import f  # not at the top of the module, because the import takes half a second

    # We assume that recorded returns have the same spread as the returns played now. The recorded interval is wider by
    # more than the root of F's quantile in one of a thousand pairs of samples. The limit is twice as wide because
    # returns have heavy tails.
    own = _half(again.return_interval)
    widest = own and 2 * own * math.sqrt(f.ppf(0.999, count - 1, count - 1))
    half = min(_half(recorded.return_interval), widest)
    gap = abs(recorded.mean_return - again.mean_return)
    if gap > _rounding(recorded.mean_return) + wider * math.hypot(own, half):
        return DIFFERS
    return WITHIN


def _half_of_rate(rate: float, count: int) -> float:
    """Return half the width of the 95 % interval of a rate over ``count`` episodes or tasks."""
    return 1.96 * math.sqrt(max(rate * (1 - rate), 0.0) / count)


def _rounding(value: float) -> float:
    return 1e-9 * max(1.0, abs(value))


def _half(interval: Interval | None) -> float:
    """Return half the width of an interval, or 0 if there is none because there is only one episode."""
    if interval is None:
        return 0.0
    low, high = interval
    return (high - low) / 2

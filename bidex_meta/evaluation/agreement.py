"""Whether a repeated evaluation agrees with the recorded one, class by class."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.results import MANY_TASKS
from bidex_meta.runs.atomic import Json

EQUAL = "equal"
WITHIN = "within"
DIFFERS = "differs"
_BITS = ("success", "return", "length", "episodes", "tasks", "unstable")
_MEASURES = ("success", "return")


@dataclass(frozen=True)
class Agreement:
    """One class in both evaluations."""

    name: str  # of the class; of a meta-test with split and shot
    outcome: str
    """``equal``: bit for bit; ``within``: success and return within what their intervals allow; ``differs``."""
    recorded: Json  # its recorded results
    again: Json  # its results now

    def to_json(self) -> Json:
        """Ready for JSON."""
        both = {name: [self.recorded[name], self.again[name]] for name in _MEASURES}
        return {"outcome": self.outcome, **both}


def agreements(recorded: Mapping[str, Json], again: Mapping[str, Json]) -> list[Agreement]:
    """Compares two evaluations of one policy on the same tasks and starts, per class as in ``Evaluation.to_json``.

    At worst they are independent samples: means may differ by the root of the sum of both half intervals' squares,
    widened so that of all measures of all classes one in twenty honest repetitions has any beyond (Bonferroni; by
    simulation of twenty classes: one in eighteen of 200 episodes a class, one in fourteen of 60, one in seven of 20).
    Raises BidexError where the classes differ.
    """
    if set(recorded) != set(again):
        raise BidexError(
            f"Expected the recorded evaluation to be of {', '.join(again)}, got {', '.join(recorded)}. Evaluate anew."
        )
    normal = NormalDist().inv_cdf
    wider = normal(1 - 0.025 / (len(_MEASURES) * len(recorded))) / normal(0.975)
    return [Agreement(name, _outcome(row, again[name], wider), row, again[name]) for name, row in recorded.items()]


def classes_of(evaluation: Json) -> dict[str, Json]:
    """The results in an ``evaluation.json`` by the class's name; of a meta-test those of all splits and shots."""
    if "splits" not in evaluation:
        return dict(evaluation.get("policy", evaluation)["classes"])
    rows = {}
    for split, part in evaluation["splits"].items():
        shots = part.get("by_shot") or [part["before"], part["after"]]
        for number, shot in enumerate(shots):
            rows |= {f"{name} ({split}, shot {number})": row for name, row in shot["classes"].items()}
    return rows


def _outcome(recorded: Json, again: Json, wider: float) -> str:
    if all(recorded[name] == again[name] for name in _BITS if name in recorded):
        return EQUAL
    if recorded.get("episodes", again["episodes"]) != again["episodes"]:
        return DIFFERS
    if all(_is_within(recorded, again, name, wider) for name in _MEASURES):
        return WITHIN
    return DIFFERS


def _is_within(recorded: Json, again: Json, name: str, wider: float) -> bool:
    gap = abs(recorded[name] - again[name])
    own = _half(again, f"{name}_interval")
    halves = own, min(_half(recorded, f"{name}_interval"), _widest(recorded, again, name, own))
    rounding = 1e-9 * max(1.0, abs(recorded[name]))
    return gap <= rounding + wider * math.hypot(*halves)


def _widest(recorded: Json, again: Json, name: str, own: float) -> float:
    """The most that half a recorded interval counts: what episodes of this policy can give.

    Of a success rate that follows from the rate, here half as wide again. Returns have the spread of those played now:
    of a thousand pairs of samples one is wider by more than the root of F's quantile, here twice that for heavy tails.
    """
    from scipy.stats import f

    if again["tasks"] >= MANY_TASKS:
        count = again["tasks"]
    else:
        count = again["episodes"]
    if name == "success":
        return 1.5 * 1.96 * math.sqrt(max(recorded[name] * (1 - recorded[name]), 0.0) / count)
    return own and 2 * own * math.sqrt(f.ppf(0.999, count - 1, count - 1))


def _half(row: Json, name: str) -> float:
    """Half the width of an interval, 0 where there is none: a single episode says nothing of others."""
    ends = row.get(name)
    return 0.0 if ends is None else (ends[1] - ends[0]) / 2

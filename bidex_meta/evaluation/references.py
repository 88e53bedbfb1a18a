"""What a return is measured against: the normalised score's two ends, and what an episode of broken physics counts for.

The references hold for classes with moving bases, as every suite has them. Files under ``assets/references/``:
``random.json`` and ``zero.json``, the returns of random actions and of doing nothing, the better of which is the
score's zero, and ``expert.json``; ``witness.json`` and ``script.json`` hold what witnesses get in open-loop replay and
scripted policies in closed loop. ``bidex-meta baseline`` measures all but ``expert.json``, which ``python -m
tools.experts`` of the repository writes.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypedDict

import numpy as np

from bidex_meta.config import RunConfig
from bidex_meta.errors import BidexError
from bidex_meta.runs.atomic import write_json
from bidex_meta.utils import paths
from bidex_meta.utils.files import exists, read_json
from bidex_meta.utils.validation import Finite, parse

Kind = Literal["random", "zero", "expert", "witness", "script"]
_Row = TypedDict("_Row", {"return": Finite})


class _File(TypedDict):
    classes: dict[str, _Row]


@dataclass(frozen=True)
class Reference:
    """What a class's return is measured against."""

    random: float
    """Mean return of uniform actions."""
    expert: float | None = None
    """Mean return of the best known policy; None where none is known that is above the floor."""
    zero: float | None = None
    """Mean return of zero actions, where it is known."""

    @property
    def floor(self) -> float:
        """The score's zero: what a policy that has learned nothing gets, by doing anything or nothing."""
        return self.random if self.zero is None else max(self.random, self.zero)

    def scores(self, returns: np.ndarray) -> np.ndarray | None:
        """100 · (R − R_floor) / (R_expert − R_floor) of every return R; None without an expert above the floor."""
        if self.expert is None or self.expert <= self.floor:
            return None
        return 100 * (returns - self.floor) / (self.expert - self.floor)


def counted_returns(
    returns: np.ndarray, broken: np.ndarray, reference: Reference | None, finished: np.ndarray
) -> np.ndarray:
    """Returns of a class's episodes, such that nothing is gained by breaking physics.

    A broken episode ends early, which would pay where rewards are negative. So it counts with the return of random
    actions or, where that is unknown, of the worst finished episode; with its own if that is lower, or without either.

    Args:
        returns: Sums of the unscaled reward, shape (episodes,).
        broken: Which of them ended because the physics broke, shape (episodes,), bool.
        reference: The class's, where there is one.
        finished: Returns of the class's finished episodes, of this policy and of those it is compared with, shape (n,).
    """
    others = finished if reference is None else np.array([reference.random])
    bound = others.min() if len(others) else np.inf
    return np.where(broken, np.minimum(returns, bound), returns)


def load(kind: Kind) -> dict[str, dict[str, Any]]:
    """The installation's references by class, such as ``{"return": 0.49, "source": ...}``; empty without a file."""
    return load_from(paths.assets_dir() / "references" / f"{kind}.json")


def store(path: Path, classes: dict[str, dict[str, Any]], made: dict[str, Any]) -> None:
    """Writes references: those of other classes in the file stay.

    Args:
        path: The file. Those of the installation are never a default: they are data of a release.
        classes: Per class ``return`` and whatever else was measured.
        made: How they were measured; kept with each of these classes.

    Raises:
        BidexError: The file holds something else.
    """
    known = load_from(path)
    known |= {name: {**numbers, "made": made} for name, numbers in classes.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"classes": dict(sorted(known.items()))})


def load_from(path: Path) -> dict[str, dict[str, Any]]:
    """The references in a file, by class; empty without a file.

    Raises:
        BidexError: The file holds something else.
    """
    if not exists(path):
        return {}
    try:
        content = read_json(path, "references")
        parse(content, _File, str(path))
    except BidexError as error:
        raise BidexError(f"{error} Expected a file of references or none: name another file.") from None
    return content["classes"]


def references() -> dict[str, Reference]:
    """What is known of every class whose return of random actions is known.

    An expert that is not above random and zero actions is left out: a score would mean nothing.
    """
    kinds: tuple[Kind, ...] = ("random", "zero", "expert")
    random, zero, expert = ({name: row["return"] for name, row in load(kind).items()} for kind in kinds)
    known = {name: Reference(random[name], expert.get(name), zero.get(name)) for name in random}
    return {
        name: each if each.expert is not None and each.expert > each.floor else replace(each, expert=None)
        for name, each in known.items()
    }


def references_of(world: Any) -> dict[str, Reference]:
    """Those of a world's classes by name; none of foreign classes, nor where bases are fixed."""
    slots = getattr(world, "slots", ())
    return references() if slots and all(slot.task_class.moving_base for slot in slots) else {}


def rescored(classes: dict[str, Any], config: RunConfig[Any]) -> dict[str, Any]:
    """Rows of an evaluation with the scores that today's references give their returns.

    A stored score is of the references of its day: beside another day's it would compare nothing.

    Args:
        classes: By class the row, with ``return`` and ``score``.
        config: The run's. References hold where a class has one of the names here and, as in suites, moving bases:
            the run says so itself, or it was scored when it was evaluated.

    Returns:
        The same rows; those of other bases and of foreign classes as they are.
    """
    if config.base != "moving" and all(row["score"] is None for row in classes.values()):
        return classes
    known, rows = references(), dict(classes)
    for name in known.keys() & classes.keys():
        scores = known[name].scores(np.array([classes[name]["return"]]))
        rows[name] = {**classes[name], "score": None if scores is None else float(scores[0])}
    return rows

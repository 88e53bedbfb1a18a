"""References of returns: the normalised score's two ends, and the return that an episode of broken physics counts with.

They hold for classes with moving bases, as in every suite. Under ``assets/references/``: returns of random and of zero
actions, the better of which is the score's zero; of experts (written by ``python -m tools.experts``); of witnesses in
open-loop replay and of scripted policies in closed loop. ``bidex-meta baseline`` measures all but experts'.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypedDict

import msgspec
import numpy as np

from bidex_meta.errors import BidexError
from bidex_meta.runs.atomic import Json, write_json
from bidex_meta.runs.evaluations import ClassSummary
from bidex_meta.runs.folder import AnyConfig
from bidex_meta.utils import paths
from bidex_meta.utils.files import exists, read_json
from bidex_meta.utils.validation import Finite, parse

Kind = Literal["random", "zero", "expert", "witness", "script"]
_Row = TypedDict("_Row", {"return": Finite})


class _File(TypedDict):
    classes: dict[str, _Row]


@dataclass(frozen=True)
class Reference:
    """References of a class."""

    random: float  # mean return of uniform actions
    expert: float | None = None  # mean return of the best known policy; None where none is above the floor
    zero: float | None = None  # mean return of zero actions, where it is known

    @property
    def floor(self) -> float:
        """The score's zero: what a policy that has learned nothing gets, by doing anything or nothing."""
        if self.zero is None:
            return self.random
        return max(self.random, self.zero)

    def scores(self, returns: np.ndarray) -> np.ndarray | None:
        """100 · (R − R_floor) / (R_expert − R_floor) of every return R; None without an expert above the floor."""
        if self.expert is None or self.expert <= self.floor:
            return None
        return 100 * (returns - self.floor) / (self.expert - self.floor)


def counted_returns(
    returns: np.ndarray, broken: np.ndarray, reference: Reference | None, finished: np.ndarray
) -> np.ndarray:
    """Returns (episodes,) of a class's episodes, such that nothing is gained by breaking physics.

    A ``broken`` episode (bool) ends early, which would pay where rewards are negative. So it counts with the return of
    random actions or, where that is unknown, of the worst ``finished`` episode (n,) of this policy and those it is
    compared with; with its own if that is lower, or without either.
    """
    if reference is None:
        others = finished
    else:
        others = np.array([reference.random])
    bound = others.min() if len(others) else np.inf
    return np.where(broken, np.minimum(returns, bound), returns)


def load(kind: Kind) -> dict[str, Json]:
    """The installation's references by class, such as ``{"return": 0.49, "source": ...}``; empty without a file."""
    return load_from(paths.assets_dir() / "references" / f"{kind}.json")


def store(path: Path, classes: dict[str, Json], made: Json) -> None:
    """Writes references, by class ``return`` and other measures; those of other classes in the file stay.

    ``made`` is how they were measured, stored with each class. Raises BidexError where the file holds something else.
    """
    known = load_from(path)
    known |= {name: {**numbers, "made": made} for name, numbers in classes.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"classes": dict(sorted(known.items()))})


def load_from(path: Path) -> dict[str, Json]:
    """The references in a file, by class; empty without a file. Raises BidexError where it holds something else."""
    if not exists(path):
        return {}
    try:
        content = read_json(path, "references")
        parse(content, _File, str(path))
    except BidexError as error:
        raise BidexError(f"{error} Expected a file of references or none: name another file.") from None
    return content["classes"]


def references() -> dict[str, Reference]:
    """Those of every class with a return of random actions, without experts that are not above random and zero ones."""
    kinds: tuple[Kind, ...] = ("random", "zero", "expert")
    random, zero, expert = ({name: row["return"] for name, row in load(kind).items()} for kind in kinds)
    known = {name: Reference(random[name], expert.get(name), zero.get(name)) for name in random}
    return {
        name: each if each.expert is not None and each.expert > each.floor else replace(each, expert=None)
        for name, each in known.items()
    }


def references_of(world: object) -> dict[str, Reference]:
    """Those of a world's classes by name; none of foreign classes, of version 2, nor where bases are fixed."""
    classes = [slot.task_class for slot in getattr(world, "slots", ())]
    if classes and all(each.moving_base and each.rules.as_printed for each in classes):
        return references()
    return {}


def rescored(classes: dict[str, ClassSummary], config: AnyConfig) -> dict[str, ClassSummary]:
    """Return an evaluation's results by class with scores by the present references, so that runs can be compared.

    References exist for classes with moving bases. The bases moved if the run's config says so, or if the evaluation
    has a score. Other results are returned unchanged.
    """
    if config.base != "moving" and all(row.score is None for row in classes.values()):
        return classes
    known = references()
    rows = dict(classes)
    for name in known.keys() & classes.keys():
        scores = known[name].scores(np.array([classes[name].mean_return]))
        rows[name] = msgspec.structs.replace(classes[name], score=None if scores is None else float(scores[0]))
    return rows

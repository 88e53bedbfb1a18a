"""The two ends of the normalised score: per class what a policy that has learned nothing gets, and the best known one.

They hold for classes with moving bases, as every suite has them. Files under ``assets/references/``: ``random.json``
and ``zero.json``, the returns of random actions and of doing nothing, the better of which is the score's zero, and
``expert.json``; ``witness.json`` and ``script.json`` hold what witnesses get open loop and scripts in closed loop.
``bidex-meta baseline`` measures all but ``expert.json``, which ``python -m tools.experts`` of the repository writes.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from bidex_meta import paths
from bidex_meta.config import RunConfig
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.references import Reference
from bidex_meta.reading import TABLE, check, exists, number, read_json
from bidex_meta.record.atomic import write_json

Kind = Literal["random", "zero", "expert", "witness", "script"]


def reference_path(kind: Kind) -> Path:
    """Where the references of a kind lie."""
    return paths.assets_dir() / "references" / f"{kind}.json"


def load(kind: Kind) -> dict[str, dict[str, Any]]:
    """What is known of each class by its name, e.g. ``{"return": 0.49, "source": ...}``; empty without a file."""
    path = reference_path(kind)
    return _read(path) if exists(path) else {}


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
    """What a file of references knows of each class; empty without a file.

    Raises:
        BidexError: The file holds something else.
    """
    if not exists(path):
        return {}
    try:
        return _read(path)
    except BidexError as error:
        raise BidexError(f"{error} Expected a file of references or none: name another file.") from None


def _read(path: Path) -> dict[str, dict[str, Any]]:
    content = read_json(path, "references")
    check(content, {"classes": TABLE}, path, ("classes",))
    for name, row in content["classes"].items():
        check(row, {"return": number()}, path, ("return",), f"classes.{name}.")
    return content["classes"]


def references() -> dict[str, Reference]:
    """What is known of every class whose return of random actions is known.

    An expert that is not above random and zero actions is left out: a score would mean nothing.
    """
    kinds: tuple[Kind, ...] = ("random", "zero", "expert")
    random, zero, expert = ({name: row["return"] for name, row in load(kind).items()} for kind in kinds)
    found = {}
    for name in random:
        known = Reference(random[name], expert.get(name), zero.get(name))
        found[name] = known if known.expert is not None and known.expert > known.floor else replace(known, expert=None)
    return found


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
    known = references()
    return {
        name: {**row, "score": _score(known[name], row["return"])} if name in known else row
        for name, row in classes.items()
    }


def _score(reference: Reference, value: float) -> float | None:
    """The mean score of episodes of a mean return."""
    found = reference.scores(np.array([value]))
    return None if found is None else float(found[0])

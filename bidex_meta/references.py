"""The two ends of the normalised score: per class the return of random actions and that of the best known policy.

They hold for classes with moving bases, as every suite has them. Files under ``assets/references/``: ``random.json``,
which ``bidex-meta baseline random`` measures, and ``expert.json``; ``zero.json`` tells what doing nothing gives.
"""

import json
from pathlib import Path
from typing import Any, Literal

from bidex_meta import paths
from bidex_meta.evaluate import Reference
from bidex_meta.record.atomic import write_json

Kind = Literal["random", "zero", "expert"]


def reference_path(kind: Kind) -> Path:
    """Where the references of a kind lie."""
    return paths.assets_dir() / "references" / f"{kind}.json"


def load(kind: Kind) -> dict[str, dict[str, Any]]:
    """What is known of each class by its name, e.g. ``{"return": 0.49, "source": ...}``; empty without a file."""
    path = reference_path(kind)
    return json.loads(path.read_text())["classes"] if path.is_file() else {}


def store(kind: Kind, classes: dict[str, dict[str, Any]], made: dict[str, Any], path: Path | None = None) -> Path:
    """Writes references: those of other classes stay.

    Args:
        kind: Which end.
        classes: Per class ``return`` and whatever else was measured.
        made: How they were measured; kept with each of these classes.
        path: The file; the installation's own by default.
    """
    path = path or reference_path(kind)
    known = json.loads(path.read_text())["classes"] if path.is_file() else {}
    known |= {name: {**numbers, "made": made} for name, numbers in classes.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"classes": dict(sorted(known.items()))})
    return path


def references() -> dict[str, Reference]:
    """The classes of which both ends are known, and the expert is above random and zero actions.

    Else a score means nothing.
    """
    kinds: tuple[Kind, ...] = ("random", "zero", "expert")
    low, zero, high = ({name: row["return"] for name, row in load(kind).items()} for kind in kinds)
    idle = {name: max(low[name], zero.get(name, low[name])) for name in low}
    return {name: Reference(low[name], high[name]) for name in low if high.get(name, idle[name]) > idle[name]}

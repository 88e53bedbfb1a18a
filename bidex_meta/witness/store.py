"""Witnesses on disk: one small file a class under ``assets/witnesses/``."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bidex_meta import paths
from bidex_meta.errors import BidexError
from bidex_meta.witness.planner import LEVELS


@dataclass(frozen=True)
class Witness:
    """Recorded actions and what they were made with."""

    actions: np.ndarray
    """Actions (T, action_size), float32, multiples of 1/127."""
    made: dict[str, Any]
    """Return, step of the first success, the best unsuccessful episode seen (``rival``), how it was found, versions."""


def witness_path(name: str) -> Path:
    """Where the installation's witness of a class lies. Nothing is written there by default."""
    return paths.assets_dir() / "witnesses" / f"{name}.npz"


def load_witness(name: str, path: Path | None = None) -> Witness:
    """The witness of a class, or the one in a file.

    Raises:
        BidexError: There is none.
    """
    if path is not None and not path.is_file():
        raise BidexError(f"Expected a file that `bidex-meta witness --find --file` wrote, got {path}, which is none.")
    path = path or witness_path(name)
    if not path.is_file():
        raise BidexError(f"{name} has no witness yet. Search one: bidex-meta witness --task {name} --find")
    with np.load(path, allow_pickle=False) as stored:
        actions = stored["actions"].astype(np.float32) / LEVELS
        return Witness(actions, json.loads(str(stored["made"])))


def save_witness(path: Path, actions: np.ndarray, made: dict[str, Any]) -> Path:
    """Writes a witness; actions (T, action_size) must be multiples of 1/127."""
    path.parent.mkdir(parents=True, exist_ok=True)
    levels = np.rint(actions * LEVELS).astype(np.int8)
    with path.open("wb") as file:
        np.savez_compressed(file, actions=levels, made=np.array(json.dumps(made)))
    return path

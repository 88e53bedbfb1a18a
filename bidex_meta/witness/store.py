"""Witnesses (stored reference solutions) on disk, in one file per class under ``assets/witnesses/``."""

import io
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

import numpy as np

from bidex_meta.errors import BidexError, one_line
from bidex_meta.runs.atomic import write_atomic
from bidex_meta.tasks import registry
from bidex_meta.utils import paths
from bidex_meta.utils.files import JsonObject, bounded, read_bytes
from bidex_meta.utils.validation import Finite, Whole, parse

if TYPE_CHECKING:
    from torch import Tensor

LEVELS = 127  # actions are whole multiples of 1/127, so that a byte holds one exactly
_MOST_BYTES = 50_000_000
_MOST_STEPS = 100_000
_Made = TypedDict("_Made", {"return": Finite, "first_success": Whole | None, "rival": Finite | None}, total=False)


@dataclass(frozen=True)
class Witness:
    """Recorded actions that solve a task, and how they were made."""

    actions: np.ndarray  # actions (T, action_size), float32, multiples of 1/127
    made: (
        JsonObject  # return, first successful step, best unsuccessful episode's return (``rival``), settings, versions
    )


def quantised(actions: "Tensor") -> "Tensor":
    """Round actions to multiples of 1/127, float32."""
    return (actions.clamp(-1.0, 1.0) * LEVELS).round() / LEVELS


def witness_path(name: str) -> Path:
    """Return the path at which this installation has the witness of a class, if there is one."""
    return paths.assets_dir() / "witnesses" / f"{name}.npz"


def load_witness(name: str, path: Path | None = None) -> Witness:
    """Load a class's witness from this installation, or from the file ``path``.

    Raises BidexError if the witness is missing or damaged, or if its actions do not have the class's size.
    """
    if path is None:
        path = witness_path(name)
        if not path.is_file():
            raise BidexError(f"{name} has no witness. `bidex-meta witness --all` shows which classes have one.")
        return _read(path)
    if not path.is_file():
        raise BidexError(f"Expected a witness file such as {witness_path(name)}, got {path}, which is not a file.")
    witness = _read(path)
    size = registry.get(name, moving_base=True).action_size
    if witness.actions.shape[1] != size:
        what = f"expected actions of shape (steps, {size}), as {name} has, got {witness.actions.shape}"
        raise BidexError(f"{path}: {what}. Give a witness of {name}, or leave --file out.")
    return witness


def save_witness(path: Path, actions: np.ndarray, made: JsonObject) -> Path:
    """Write a witness file and return its path.

    ``actions`` (T, action_size) must be multiples of 1/127. ``made`` says how the witness was made.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    levels = np.rint(actions * LEVELS).astype(np.int8)
    write_atomic(path, lambda file: np.savez_compressed(file, actions=levels, made=np.array(json.dumps(made))))
    return path


def _read(path: Path) -> Witness:
    content = io.BytesIO(read_bytes(path, "a witness", _MOST_BYTES))
    try:
        with zipfile.ZipFile(content) as archive:
            # A small archive may unpack to any size.
            if sum(part.file_size for part in archive.infolist()) > _MOST_BYTES:
                raise ValueError("it unpacks to too much")
        content.seek(0)
        with np.load(content, allow_pickle=False) as stored:
            levels = stored["actions"]
            made = bounded(json.loads(str(stored["made"])))
    except Exception as error:  # zipfile, zlib and numpy raise a dozen kinds of errors for a damaged file
        reason = one_line(error)[:150].rstrip(".")
        raise BidexError(f"Expected a witness at {path}, but {reason}. Copy the file again.") from None
    if levels.dtype != np.int8 or levels.ndim != 2 or not 1 <= len(levels) <= _MOST_STEPS:
        what = f"got {levels.dtype} of shape {levels.shape}"
        raise BidexError(f"{path}: expected actions as bytes, (steps, actions), {what}.")
    parse(made, _Made, str(path))
    return Witness(levels.astype(np.float32) / LEVELS, made)

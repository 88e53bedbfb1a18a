"""Read data sets from elsewhere, such as Minari's: check their arrays, and read the range of their actions."""

import json

import numpy as np

from bidex_meta.data.part_files import H5, Json
from bidex_meta.errors import BidexError, shortened

_SPACES = {"observations": "observation_space", "actions": "action_space"}
"""Arrays with several numbers per step, and the metadata entries of their spaces."""
_TYPES = {"observations": np.float32, "actions": np.float32, "rewards": np.float32}
"""Types of the arrays in memory; those of other arrays are bool."""


def check_spaces(content: Json, name: str) -> None:
    """Raise BidexError if the spaces in ``metadata.json`` say that observations or actions are not flat."""
    for array, entry in _SPACES.items():
        space = _space(content, entry)
        kind = space.get("type", "Box")
        shape = space.get("shape", [0])
        if kind != "Box" or not isinstance(shape, list) or len(shape) != 1:
            raise _not_flat(name, array, f"a Box of shape {shortened(shape)}" if kind == "Box" else f"{kind} ones")


def numbers(stored: H5, array: str, name: str, length: int | None = None) -> np.ndarray:
    """Read an array of a stored episode; ``array`` is Minari's name of it, such as ``observations``.

    The result has the type of ``Episode``'s array, in native byte order; numbers too large for float32 become infinite.
    Raises BidexError for a wrong shape or type, or if ``length`` is given and is not the array's length.
    """
    if not hasattr(stored, "shape"):
        raise _not_flat(name, array, f"a group of {shortened(', '.join(stored))}")
    shape = stored.shape or ()
    kind = stored.dtype
    if len(shape) != 1 + (array in _SPACES) or kind.kind not in "biuf":
        raise _not_flat(name, array, f"an array of shape {shape} and type {kind}")
    if length not in (None, len(stored)):
        raise BidexError(f"{name}: expected {length} {array} in {stored.name}, got {len(stored)}. Record it again.")
    with np.errstate(over="ignore"):
        return np.asarray(stored[()]).astype(_TYPES.get(array, np.bool_), copy=False)


def action_bounds(content: Json, name: str, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return lower and upper bounds of actions, (a,) each, float64, which are mapped to ±1.

    Raises BidexError unless all bounds are finite and upper bounds are above lower bounds.
    """
    space = _space(content, "action_space")
    try:
        low, high = (np.array(space[end], np.float64) for end in ("low", "high"))
    except (KeyError, TypeError, ValueError, OverflowError):
        low = high = np.zeros(0)
    fits = low.shape == high.shape == (size,)
    if not fits or not np.isfinite([low, high]).all() or (low >= high).any():
        got = " to ".join(shortened(space.get(end)) for end in ("low", "high"))
        fault = f"Expected finite bounds of the {size} actions of {name}, which become -1 and 1, got {got}"
        raise BidexError(f"{fault}. Store it with an action_space that has them.")
    return low, high


def _space(content: Json, entry: str) -> Json:
    """Read a space as Minari writes it, JSON within JSON; return an empty dict if there is no space."""
    space = content.get(entry)
    try:
        if isinstance(space, str):
            space = json.loads(space)
    except (ValueError, RecursionError):
        return {}
    return space if isinstance(space, dict) else {}


def _not_flat(name: str, array: str, got: str) -> BidexError:
    if array in _SPACES:
        expected = "a row of numbers"
    else:
        expected = "a number"
    return BidexError(f"{name}: expected {expected} a step as {array}, got {got}. Flatten them and store it again.")

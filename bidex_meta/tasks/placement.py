"""Start poses of objects: the nominal pose is shifted and turned per task, and jittered a little per episode.

A turn (yaw) is a rotation about the vertical axis through the object's origin.
"""

from collections.abc import Iterable

import torch
from torch import Tensor

from bidex_meta.tasks.variation import VariationSpace
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.maths import constant, multiply, wxyz, xyzw
from bidex_meta.utils.validation import NonNegative, Text

SHIFT, TURN = 0.03, 0.2617993877991494
"""Half widths of a task's shift along x and y, metres, and of its turn, 15 degrees in radians (docs/figures.md,
decisions)."""
JITTER, JITTER_TURN = 0.005, 0.05
"""Half widths of an episode's additional shift, metres, and of its additional turn, radians."""
DRAWS = 3
"""Number of uniform numbers that an episode draws for each jittered object: x, y, turn."""


@checked_arguments
def placed(name: Text, shift: NonNegative = SHIFT, turn: NonNegative = TURN) -> VariationSpace:
    """Return the variation space of an object's place: its shift along x and y, and its turn about the vertical axis.

    The components are ``<name>_x`` and ``<name>_y``, at most ``shift`` metres from 0, and ``<name>_yaw``, at most
    ``turn`` radians from 0.
    """
    half = (shift, shift, turn)
    return VariationSpace((f"{name}_x", f"{name}_y", f"{name}_yaw"), tuple(-h for h in half), half)


def yaw_quaternion(yaw: Tensor) -> Tensor:
    """Return rotations about z as quaternions (x, y, z, w), shape (n, 4), rounded to single precision.

    Vectorised sines, and the scalar sines that are computed for the last entries of an array, may differ in the last
    bit of double precision. Without rounding, an environment's start could therefore depend on its position in a batch.
    """
    half = 0.5 * yaw
    zero = torch.zeros_like(yaw)
    return torch.stack((zero, zero, half.sin(), half.cos()), dim=-1).float().to(yaw.dtype)


def place(pose: Tensor, frozen: Tensor, draws: Tensor | None = None) -> None:
    """Shift and turn an object's nominal poses ``pose`` (n, 7), quaternion (w, x, y, z), in place.

    ``frozen`` (n, 3) holds the shift along x and y, metres, and the yaw, radians, that the tasks fix. ``draws`` (n, 3)
    in [-1, 1] select the jitter that episodes add. A fixture has no jitter, so its ``draws`` are None.
    """
    if draws is None:
        shift = frozen
    else:
        shift = frozen + draws * constant((JITTER, JITTER, JITTER_TURN), draws)
    pose[:, :2] += shift[:, :2]
    pose[:, 3:] = wxyz(multiply(yaw_quaternion(shift[:, 2]), xyzw(pose[:, 3:])))


def place_all(names: Iterable[str], qpos: dict[str, Tensor], frozen: dict[str, Tensor], draws: Tensor) -> None:
    """Shift and turn several objects in ``qpos``, in place.

    ``frozen`` holds the shift and yaw (n, 3) of each object under the object's name. For its jitter each object takes
    the next ``DRAWS`` columns of ``draws``.
    """
    for name, jitter in zip(names, draws.split(DRAWS, dim=1), strict=True):
        place(qpos[name], frozen[name], jitter)

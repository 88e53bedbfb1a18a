"""Limits on the numbers in a simulation's state, and checks of a saved state before it is restored."""

from collections.abc import Mapping

import mujoco
import numpy as np
import torch
from torch import Tensor

from bidex_meta.errors import BidexError

LARGEST = 1e6
"""Bound of positions (m, rad) and velocities (m/s, rad/s), far above the values of healthy rows (hands/README.md).
Forces, accelerations, controls and time are bounded by MuJoCo's own 1e10."""
# Bounds of a quaternion's length. MuJoCo treats a shorter quaternion as no rotation.
SHORTEST = 1e-3
LONGEST = 1e3
STATE = (
    *("time", "qpos", "qvel", "act", "history", "qacc_warmstart", "ctrl", "qfrc_applied", "xfrc_applied", "eq_active"),
    *("mocap_pos", "mocap_quat", "userdata"),
)
"""The state that a simulation carries from one step to the next; fields that a model lacks are skipped."""


def quaternion_columns(model: mujoco.MjModel) -> np.ndarray:
    """Return the columns of ``qpos`` that hold a quaternion, four for each free and ball joint, shape (4 k,)."""
    kinds = np.asarray(model.jnt_type)
    free = mujoco.mjtJoint.mjJNT_FREE
    ball = mujoco.mjtJoint.mjJNT_BALL
    first = np.concatenate((model.jnt_qposadr[kinds == free] + 3, model.jnt_qposadr[kinds == ball]))
    return (np.sort(first)[:, None] + np.arange(4)).ravel()


def checked_state(state: object, views: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return a saved state in the shapes and dtypes of ``views``, the state fields of the engine that will restore it.

    The state may come from either engine, C MuJoCo or mujoco_warp. Raises BidexError for a state of another model or
    another number of simulations, or if one of its numbers is not finite.
    """
    if not isinstance(state, Mapping) or set(state) != set(views):
        if isinstance(state, Mapping):
            got = sorted(map(str, state))
        else:
            got = type(state).__name__
        raise BidexError(f"Expected an engine's state with {sorted(views)}, got {got}; build the same world first.")
    return {name: _checked_field(name, state[name], view) for name, view in views.items()}


def dense(given: object, device: torch.device, dtype: torch.dtype | None = None) -> Tensor | None:
    """Convert a tensor, an array or nested lists to a dense, detached tensor on ``device``.

    If ``dtype`` is None, the type of the numbers is kept. Returns None if the input is not an array of real numbers.
    """
    try:
        # The copy is in C order, because torch does not accept arrays with negative strides.
        if isinstance(given, Tensor):
            tensor = given.detach()
        else:
            tensor = torch.as_tensor(np.asarray(given, order="C"))
        usable = tensor.layout == torch.strided and not tensor.is_complex()
        if usable:
            return tensor.to(device=device, dtype=dtype)
        return None
    except (TypeError, ValueError, RuntimeError, OverflowError, NotImplementedError):
        return None


def _checked_field(name: str, value: object, view: Tensor) -> Tensor:
    if not isinstance(value, Tensor) or value.shape[:1] != view.shape[:1] or value.numel() != view.numel():
        if isinstance(value, Tensor):
            got = tuple(value.shape)
        else:
            got = type(value).__name__
        raise BidexError(
            f"Expected {name} of an engine's state of shape {tuple(view.shape)}, got {got}; build the world with the "
            "same suite and num_envs."
        )
    tensor = dense(value, view.device, view.dtype)
    if tensor is None or value.is_floating_point() != view.is_floating_point():
        raise BidexError(f"Expected {name} of an engine's state as {view.dtype}, got {value.dtype}; take another.")
    value = tensor.reshape(view.shape)
    if view.is_floating_point() and not bool(value.isfinite().all()):
        row = int((~value.reshape(len(value), -1).isfinite().all(dim=1)).nonzero()[0])
        raise BidexError(
            f"Expected finite numbers in {name} of an engine's state, got others in row {row}; take an older state."
        )
    return value


def outside(fields: Mapping[str, Tensor], rows: Tensor) -> Tensor:
    """Return, for each simulation in ``rows``, whether one of its numbers is too large, infinite or NaN, bool (k,).

    ``rows`` (k,) are indices of simulations. ``fields`` are the tensors of the state, with one row per simulation.
    """
    bad = torch.zeros(len(rows), dtype=torch.bool, device=rows.device)
    for name, value in fields.items():  # a comparison with NaN is false
        if name in ("qpos", "qvel", "mocap_pos", "mocap_quat"):
            limit = LARGEST
        else:
            limit = float(mujoco.mjMAXVAL)
        bad |= ~(value[rows].unsqueeze(-1).flatten(1).abs() <= limit).all(dim=1)
    return bad

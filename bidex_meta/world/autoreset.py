"""When rows start anew: within the step that ended them (training), or when they are told to (evaluation)."""

from typing import Any

import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor

from bidex_meta.errors import BidexError, unknown_name

_MODES = {"SAME_STEP": AutoresetMode.SAME_STEP, "DISABLED": AutoresetMode.DISABLED}


def checked_mode(mode: AutoresetMode | str | None) -> AutoresetMode:
    """The mode as a member; None: SAME_STEP.

    Raises:
        BidexError: Neither SAME_STEP nor DISABLED, in whatever spelling.
    """
    if mode is None:
        return AutoresetMode.SAME_STEP
    name = mode.name if isinstance(mode, AutoresetMode) else str(mode)
    for known, value in _MODES.items():
        if name.upper().replace("-", "").replace("_", "") == known.replace("_", ""):
            return value
    raise unknown_name("autoreset_mode", name, _MODES)


def reset_mask(options: dict[str, Any] | None, num_envs: int, device: torch.device, ready: bool) -> Tensor:
    """The rows that ``reset`` is asked to start, shape (num_envs,), bool: those of ``reset_mask``, else all.

    Raises:
        BidexError: A mask of another shape or dtype, or one with false entries before the first full reset.
    """
    mask = (options or {}).get("reset_mask")
    if mask is None:
        return torch.ones(num_envs, dtype=torch.bool, device=device)
    mask = torch.as_tensor(mask, device=device)
    if mask.shape != (num_envs,) or mask.dtype != torch.bool:
        raise BidexError(f"Expected a bool reset_mask of shape ({num_envs},), got {mask.dtype} {tuple(mask.shape)}.")
    if not ready and not mask.all():
        raise BidexError("Expected a full reset first, got a reset_mask with false entries; call reset() once without.")
    return mask

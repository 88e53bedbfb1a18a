"""When rows start anew: within the step that ended them (training), or when they are told to (evaluation)."""

from collections.abc import Mapping
from typing import Any

import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor

from bidex_meta.engine.health import dense
from bidex_meta.errors import BidexError, shortened, unknown_name
from bidex_meta.maths import check_precision
from bidex_meta.validation import whole_number
from bidex_meta.world.contract import VectorWorld

_MODES = {"SAME_STEP": AutoresetMode.SAME_STEP, "DISABLED": AutoresetMode.DISABLED}


def checked_mode(mode: AutoresetMode | str | None) -> AutoresetMode:
    """The mode as a member; None: SAME_STEP. Every world asks for it as it is made.

    Raises:
        BidexError: Neither SAME_STEP nor DISABLED, in whatever spelling; or torch's default precision is not single.
    """
    check_precision()
    if mode is None:
        return AutoresetMode.SAME_STEP
    name = mode.name if isinstance(mode, AutoresetMode) else str(mode)
    for known, value in _MODES.items():
        if name.upper().replace("-", "").replace("_", "") == known.replace("_", ""):
            return value
    raise unknown_name("autoreset_mode", name, _MODES)


def set_stagger(world: VectorWorld, stagger: bool) -> None:
    """Whether first episodes begin at random elapsed steps, from the world's next first reset on.

    Other libraries sum rewards from the first step to the first end, so what is made for them begins at 0 by default.

    Args:
        world: With wrappers of ours or Gymnasium's around it or none; one without ``stagger`` is left as it is.
        stagger: What its ``stagger`` shall be.
    """
    inner: Any = getattr(world, "unwrapped", world)
    if hasattr(inner, "stagger"):
        inner.stagger = stagger


def reset_mask(options: dict[str, Any] | None, num_envs: int, device: torch.device, ready: bool) -> Tensor:
    """The rows that ``reset`` is asked to start, shape (num_envs,), bool: those of ``reset_mask``, else all.

    Raises:
        BidexError: Another option, a mask of another shape or dtype, or one with false entries before the first full
            reset; or torch's default precision is not single.
    """
    check_precision()
    if options is not None and not isinstance(options, Mapping):
        raise BidexError(f"Expected reset options as a dict, got {shortened(options)}. Leave options out.")
    if unknown := sorted(map(str, (options or {}).keys() - {"reset_mask"})):
        raise BidexError(
            f"Expected no reset option but reset_mask, got {', '.join(unknown)}. To start some rows alone give a bool "
            f"mask of all: reset(options={{'reset_mask': mask}}), shape ({num_envs},)."
        )
    mask = (options or {}).get("reset_mask")
    if mask is None:
        return torch.ones(num_envs, dtype=torch.bool, device=device)
    made = dense(mask, device)
    if made is None or made.shape != (num_envs,) or made.dtype != torch.bool:
        got = shortened(mask) if made is None else f"{made.dtype} {tuple(made.shape)}"
        raise BidexError(
            f"Expected a bool reset_mask of shape ({num_envs},), got {got}. True starts a row; without it all start."
        )
    if not ready and not made.all():
        raise BidexError("Expected a full reset first, got a reset_mask with false entries; call reset() once without.")
    return made


def checked_seed(seed: Any, mask: Tensor) -> int:
    """The seed of a reset.

    Raises:
        BidexError: No whole number from 0 on, or a seed together with a mask that leaves rows out.
    """
    number = whole_number("seed", seed, 0)  # one of all rows, whose draws differ
    if not mask.all():
        raise BidexError("Expected a seed with a full reset, got it with a reset_mask; a seed starts all rows anew.")
    return number

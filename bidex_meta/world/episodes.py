"""Episodes of a world: their counters, how a reset begins them, and what is reported where they end."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor

from bidex_meta.engine.health import dense
from bidex_meta.errors import BidexError, shortened, unknown_name
from bidex_meta.utils.maths import check_precision
from bidex_meta.utils.validation import whole_number
from bidex_meta.world.contract import Info, Options, VectorWorld

_MODES = {"SAME_STEP": AutoresetMode.SAME_STEP, "DISABLED": AutoresetMode.DISABLED}
_FINAL = ("success", "unstable", "reward_unscaled")


@dataclass
class Episodes:
    """Counters of the running episodes.

    Attributes:
        number: Index of the running episode, counted from the last seeding, shape (n,), int64; -1 before the first.
        elapsed: Control steps since its start, shape (n,), int64.
        counts: Whether it enters statistics (a shortened first episode does not), shape (n,), bool.
        finished: Whether it has ended and waits for a reset (DISABLED autoreset only), shape (n,), bool.
        terminated: Flag of a finished episode, shape (n,), bool.
        truncated: Flag of a finished episode, shape (n,), bool.
        success: Whether it succeeded at any step, shape (n,), bool.
        reward: Sum of the rewards that the world returned, shape (n,).
        unscaled: Sum of the rewards by the printed formula, shape (n,).
        length: Steps counted in these sums, shape (n,), int64.
    """

    number: Tensor
    elapsed: Tensor
    counts: Tensor
    finished: Tensor
    terminated: Tensor
    truncated: Tensor
    success: Tensor
    reward: Tensor
    unscaled: Tensor
    length: Tensor

    @classmethod
    def fresh(cls, num: int, device: torch.device) -> "Episodes":
        """Counters of n environments none of which has begun."""

        def zeros(dtype: torch.dtype) -> Tensor:
            return torch.zeros(num, dtype=dtype, device=device)

        flags = [zeros(torch.bool) for _ in range(5)]
        return cls(
            zeros(torch.int64) - 1, zeros(torch.int64), flags[0], flags[1], flags[2], flags[3], flags[4],
            zeros(torch.float32), zeros(torch.float32), zeros(torch.int64),
        )  # fmt: skip

    def begin(self, mask: Tensor, elapsed: Tensor) -> None:
        """Starts episodes in the environments of a mask at a given number of elapsed steps, shape (n,)."""
        self.elapsed = torch.where(mask, elapsed, self.elapsed)
        self.counts = torch.where(mask, elapsed == 0, self.counts)
        for name in ("finished", "terminated", "truncated", "success"):
            setattr(self, name, getattr(self, name) & ~mask)
        for name in ("reward", "unscaled", "length"):
            setattr(self, name, getattr(self, name).masked_fill(mask, 0))

    def add(self, active: Tensor, reward: Tensor, unscaled: Tensor, success: Tensor) -> None:
        """Counts one step of the active environments."""
        self.elapsed = self.elapsed + active
        self.length = self.length + active
        self.success = self.success | (success & active)
        self.reward = self.reward + reward * active
        self.unscaled = self.unscaled + unscaled * active

    def statistics(self) -> dict[str, Tensor]:
        """Return, length, success and unscaled return so far, as ``info["so_far"]`` carries them."""
        return {
            "r": self.reward.clone(),
            "l": self.length.clone(),
            "success": self.success.clone(),
            "unscaled": self.unscaled.clone(),
        }

    def state_dict(self) -> dict[str, Tensor]:
        """All counters, copied."""
        return {f.name: getattr(self, f.name).clone() for f in fields(self)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Puts back what ``state_dict`` gave."""
        for f in fields(self):
            setattr(self, f.name, state[f.name].to(getattr(self, f.name).device, copy=True))


def ended_info(info: Info) -> dict[str, Any]:
    """Gymnasium's keys for what ended in a step; environments outside a mask are zero, as theirs.

    Args:
        info: The contract's keys of the step.

    Returns:
        ``episode`` (r, l, success, unscaled of (N,)) and its mask ``_episode``: ended, and counts. ``final_info`` with
        the last step's values, ``episode`` once more, and a mask each; its own mask ``_final_info``: ended.
    """
    ended, counted = info["_final_obs"], info["counted"]
    episode = {name: value.masked_fill(~counted, 0) for name, value in info["so_far"].items()}
    final: Info = {name: info[name].masked_fill(~ended, 0) for name in _FINAL}
    final |= {f"_{name}": ended for name in _FINAL} | {"episode": dict(episode), "_episode": counted}
    return {"episode": episode, "_episode": counted, "final_info": final, "_final_info": ended}


class Clock:
    """Seconds that the episodes of ``num`` environments have taken: ``t`` of ``episode``; no part of the state."""

    def __init__(self, num: int, device: torch.device) -> None:
        self._began = torch.full((num,), time.perf_counter(), dtype=torch.float64, device=device)

    def begin(self, mask: Tensor) -> None:
        """Episodes of the environments of a mask begin now."""
        self._began = torch.where(mask, time.perf_counter(), self._began)

    def stamp(self, info: Info) -> None:
        """Adds ``t``, float32 (N,), where ``info`` has ended episodes."""
        if "episode" in info:
            took = torch.where(info["_episode"], time.perf_counter() - self._began, 0).float()
            info["episode"]["t"], info["final_info"]["episode"]["t"] = took, took.clone()


def checked_mode(mode: AutoresetMode | str | None) -> AutoresetMode:
    """The autoreset mode as a member; None: SAME_STEP.

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


def reset_mask(options: Options | None, num_envs: int, device: torch.device, ready: bool) -> Tensor:
    """The environments that ``reset`` is asked to start, shape (num_envs,), bool: those of ``reset_mask``, else all.

    Raises:
        BidexError: Another option, a mask of another shape or dtype, or one with false entries before the first full
            reset; or torch's default precision is not single.
    """
    check_precision()
    if options is not None and not isinstance(options, Mapping):
        raise BidexError(f"Expected reset options as a dict, got {shortened(options)}. Leave options out.")
    if unknown := sorted(map(str, (options or {}).keys() - {"reset_mask"})):
        raise BidexError(
            f"Expected no reset option but reset_mask, got {', '.join(unknown)}. To start some environments alone give "
            f"a bool mask of all: reset(options={{'reset_mask': mask}}), shape ({num_envs},)."
        )
    given = (options or {}).get("reset_mask")
    if given is None:
        return torch.ones(num_envs, dtype=torch.bool, device=device)
    mask = dense(given, device)
    if mask is None or mask.shape != (num_envs,) or mask.dtype != torch.bool:
        got = shortened(given) if mask is None else f"{mask.dtype} {tuple(mask.shape)}"
        raise BidexError(f"Expected a bool reset_mask of shape ({num_envs},), got {got}. Without it all start.")
    if not ready and not mask.all():
        raise BidexError("Expected a full reset first, got a reset_mask with false entries; call reset() once without.")
    return mask


def checked_seed(seed: object, mask: Tensor) -> int:
    """The seed of a reset.

    Raises:
        BidexError: No whole number from 0 on, or a seed together with a mask that leaves environments out.
    """
    number = whole_number("seed", seed, 0)
    if not mask.all():
        raise BidexError("Expected a seed with a full reset, got it with a reset_mask; a seed starts all anew.")
    return number

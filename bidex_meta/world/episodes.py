"""Episodes of a world: their counters, the arguments of a reset, and the report when they end."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor

from bidex_meta.engine.health import dense
from bidex_meta.errors import BidexError, shortened, unknown_name
from bidex_meta.rules import HELD_STEPS
from bidex_meta.utils.maths import check_precision
from bidex_meta.utils.validation import true_or_false, whole_number
from bidex_meta.world.contract import Info, Options, VectorWorld

_MODES = {mode.name: mode for mode in (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED)}
_FINAL = ("success", "unstable", "reward_unscaled")


@dataclass
class Episodes:
    """Counters of the running episodes, each (n,): bool, int64, or float32 for sums of rewards."""

    number: Tensor
    """Index of the running episode, counted from the last seeding; -1 before the first."""
    elapsed: Tensor
    """Control steps since the episode's start; a shortened first episode starts above 0."""
    counts: Tensor
    """True if the episode enters statistics (a shortened first episode does not)."""
    finished: Tensor
    """True if the episode has ended and its environment waits for a reset (never in SAME_STEP mode). The next two
    fields are the flags of the episode's last step."""
    terminated: Tensor
    truncated: Tensor
    success: Tensor
    """True if the goal was met at any step of the episode."""
    held: Tensor
    """Number of consecutive steps, up to the last one, in which the goal was met."""
    reward: Tensor
    unscaled: Tensor
    """Sum of the rewards before the suite's scale of the class; ``reward`` is the sum of the scaled rewards."""
    length: Tensor
    """Number of steps over which the rewards are summed."""

    @classmethod
    def fresh(cls, num: int, device: torch.device) -> "Episodes":
        """Return counters of n environments in which no episode has begun."""
        kinds = [torch.int64] * 2 + [torch.bool] * 5 + [torch.int64] + [torch.float32] * 2 + [torch.int64]
        number, *rest = (torch.zeros(num, dtype=kind, device=device) for kind in kinds)
        return cls(number - 1, *rest)

    def begin(self, mask: Tensor, elapsed: Tensor) -> None:
        """Start episodes in the environments of a mask, with ``elapsed`` (n,) steps counted already."""
        self.elapsed = torch.where(mask, elapsed, self.elapsed)
        self.counts = torch.where(mask, elapsed == 0, self.counts)
        for name in ("finished", "terminated", "truncated", "success"):
            setattr(self, name, getattr(self, name) & ~mask)
        for name in ("held", "reward", "unscaled", "length"):
            setattr(self, name, getattr(self, name).masked_fill(mask, 0))

    def add(self, active: Tensor, reward: Tensor, unscaled: Tensor, solved: Tensor, unstable: Tensor) -> None:
        """Count one step of the active environments; an episode whose physics broke is no success."""
        self.elapsed = self.elapsed + active
        self.length = self.length + active
        self.success = torch.where(active, (self.success | solved) & ~unstable, self.success)
        self.held = torch.where(active, (self.held + 1) * solved, self.held)
        self.reward = self.reward + reward * active
        self.unscaled = self.unscaled + unscaled * active

    @property
    def solved_at_end(self) -> Tensor:
        """Return which environments have met their goal in each of the last ``HELD_STEPS`` steps, (n,), bool.

        If success counts at the end, an episode that ends now is a success in these environments.
        """
        return self.held >= HELD_STEPS

    def statistics(self, at_end: bool) -> dict[str, Tensor]:
        """Return statistics of the running episodes, as in ``info["running"]``.

        With ``at_end`` an episode is a success if its goal has been held up to the present step. Otherwise it is a
        success if its goal was met at any step.
        """
        if at_end:
            success = self.solved_at_end
        else:
            success = self.success
        values = {"r": self.reward, "l": self.length, "success": success, "unscaled": self.unscaled}
        return {name: value.clone() for name, value in values.items()}

    def state_dict(self) -> dict[str, Tensor]:
        """Return all counters, copied."""
        return {f.name: getattr(self, f.name).clone() for f in fields(self)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore a ``state_dict``."""
        for f in fields(self):
            setattr(self, f.name, state[f.name].to(getattr(self, f.name).device, copy=True))


def ended_info(info: Info) -> Info:
    """Return the keys that Gymnasium expects in the info of a step in which episodes ended.

    ``info`` has the keys that ``contract`` describes. ``episode`` holds r, l, success and unscaled, (N,) each; its mask
    ``_episode`` marks the ended episodes that statistics include. ``final_info`` holds values of the last step and
    ``episode`` again, each with a mask. ``_final_info`` marks all environments whose episode ended. Values are zero in
    environments that a mask does not mark.
    """
    ended = info["_final_obs"]
    episode_mask = info["episode_mask"]
    episode = {name: value.masked_fill(~episode_mask, 0) for name, value in info["running"].items()}
    final: Info = {name: info[name].masked_fill(~ended, 0) for name in _FINAL}
    final |= {f"_{name}": ended for name in _FINAL} | {"episode": dict(episode), "_episode": episode_mask}
    return {"episode": episode, "_episode": episode_mask, "final_info": final, "_final_info": ended}


class Clock:
    """Measures how many seconds each episode of ``num`` environments takes.

    ``info["episode"]["t"]`` reports these times. They are not part of a world's state.
    """

    def __init__(self, num: int, device: torch.device) -> None:
        self._began = torch.full((num,), time.perf_counter(), dtype=torch.float64, device=device)

    def begin(self, mask: Tensor) -> None:
        """Set the start time of the episodes in the environments of a mask to the present time."""
        self._began = torch.where(mask, time.perf_counter(), self._began)

    def stamp(self, info: Info) -> None:
        """Add the seconds ``t``, float32 (N,), to ``episode`` if ``info`` has this key."""
        if "episode" in info:
            took = torch.where(info["_episode"], time.perf_counter() - self._began, 0).float()
            info["episode"]["t"] = took
            info["final_info"]["episode"]["t"] = took.clone()


def checked_mode(mode: AutoresetMode | str | None) -> AutoresetMode:
    """Return the member of ``AutoresetMode`` for a mode or its name; None stands for SAME_STEP.

    Upper and lower case, hyphens and underscores make no difference in names. Raises BidexError for other modes, and if
    torch's default precision is not single.
    """
    check_precision()
    if mode is None:
        return AutoresetMode.SAME_STEP
    if isinstance(mode, AutoresetMode):
        name = mode.name
    else:
        name = str(mode)
    for known, value in _MODES.items():
        if name.upper().replace("-", "").replace("_", "") == known.replace("_", ""):
            return value
    raise unknown_name("autoreset_mode", name, _MODES)


def set_stagger(world: VectorWorld, stagger: bool) -> None:
    """Set whether a world shortens the first episode of each environment by a random number of steps.

    The setting takes effect at the world's first reset, or at the next reset with a seed. Worlds that are made for
    other libraries do not shorten episodes by default, because these libraries would report a shortened episode like
    any other. The world may be wrapped. A world without the attribute ``stagger`` is not changed.
    """
    stagger = true_or_false("stagger", stagger)
    inner: Any = getattr(world, "unwrapped", world)
    if hasattr(inner, "stagger"):
        inner.stagger = stagger


def reset_mask(options: Options | None, num_envs: int, device: torch.device, ready: bool) -> Tensor:
    """Return the environments that ``reset`` starts, bool (num_envs,): the option ``reset_mask``, by default all.

    ``ready`` says whether a full reset has been made. Raises BidexError for any other option, for a mask of another
    shape or dtype, for a mask with false entries before the first full reset, and if torch's default precision is not
    single.
    """
    check_precision()
    if options is not None and not isinstance(options, Mapping):
        raise BidexError(f"Expected reset options as a dict, got {shortened(options)}. Leave options out.")
    if unknown := sorted(map(str, (options or {}).keys() - {"reset_mask"})):
        raise BidexError(
            f"Expected no reset option but reset_mask, got {', '.join(unknown)}. To start only some environments, give "
            f"a bool mask of all: reset(options={{'reset_mask': mask}}), shape ({num_envs},)."
        )
    given = (options or {}).get("reset_mask")
    if given is None:
        return torch.ones(num_envs, dtype=torch.bool, device=device)
    mask = dense(given, device)
    if mask is None or mask.shape != (num_envs,) or mask.dtype != torch.bool:
        if mask is None:
            got = shortened(given)
        else:
            got = f"{mask.dtype} {tuple(mask.shape)}"
        raise BidexError(
            f"Expected a bool reset_mask of shape ({num_envs},), got {got}. Without the mask, all environments start."
        )
    if not ready and not mask.all():
        raise BidexError("Expected a full reset first, got a reset_mask with false entries; call reset() once without.")
    return mask


def checked_seed(seed: object, mask: Tensor) -> int:
    """Return the seed of a reset; raise BidexError unless it is a non-negative integer and the reset is full."""
    number = whole_number("seed", seed, 0)
    if not mask.all():
        raise BidexError("Expected a seed with a full reset, got a reset_mask too; a seed restarts all environments.")
    return number


def check_single_reset(seed: object, options: object) -> None:
    """Raise BidexError unless the seed is None or a non-negative integer, and there are no options."""
    if seed is not None:
        whole_number("seed", seed, 0)
    if options is not None and not isinstance(options, Mapping):
        raise BidexError(f"Expected reset options as a dict, got {shortened(options)}. Leave options out.")
    if options:
        raise BidexError(f"Expected no reset options, got {', '.join(map(str, options))}. Leave options out.")

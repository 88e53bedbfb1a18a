"""Episode bookkeeping: elapsed steps, returns, successes. All tensors count the world's rows."""

from dataclasses import dataclass, fields

import torch
from torch import Tensor


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
        """Counters of n rows none of which has begun."""

        def zeros(dtype: torch.dtype) -> Tensor:
            return torch.zeros(num, dtype=dtype, device=device)

        flags = [zeros(torch.bool) for _ in range(5)]
        return cls(
            zeros(torch.int64) - 1, zeros(torch.int64), flags[0], flags[1], flags[2], flags[3], flags[4],
            zeros(torch.float32), zeros(torch.float32), zeros(torch.int64),
        )  # fmt: skip

    def begin(self, mask: Tensor, elapsed: Tensor) -> None:
        """Starts episodes of the mask's rows at a given number of elapsed steps, shape (n,)."""
        self.elapsed = torch.where(mask, elapsed, self.elapsed)
        self.counts = torch.where(mask, elapsed == 0, self.counts)
        for name in ("finished", "terminated", "truncated", "success"):
            setattr(self, name, getattr(self, name) & ~mask)
        for name in ("reward", "unscaled", "length"):
            setattr(self, name, getattr(self, name).masked_fill(mask, 0))

    def add(self, active: Tensor, reward: Tensor, unscaled: Tensor, success: Tensor) -> None:
        """Counts one step of the active rows."""
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

"""Several steps as one transition: their discounted rewards, and the state that they lead to.

The replay keeps consecutive steps of each row, so nothing more is stored. A stretch ends early where its episode ends,
before a step that broke physics, and at the newest step; what follows it is then worth gamma to the power of its steps.
Rewards of an older policy are taken as they were, without a correction.
"""

from dataclasses import replace

import torch
from torch import Tensor

from bidex_algos.experience.replay import Replay, Transitions


class Stretches:
    """Up to ``n`` steps in a row from each place.

    Args:
        replay: Where they lie.
        places: Of the first steps, int64 (batches, B).
        n: Steps at most.
        gamma: Discount per step.

    Attributes:
        last: Places of the last steps, (batches, B).
    """

    def __init__(self, replay: Replay, places: Tensor, n: int, gamma: float | Tensor):
        self.replay, self.first, self.last = replay, places, places
        self.rewards: Tensor | None = None
        if n > 1:
            self._walk(n, gamma)

    def _walk(self, n: int, gamma: float | Tensor) -> None:
        replay = self.replay
        newest = replay.added % replay.slots  # the slot of an observation that no step has left yet
        self.rewards, self.steps = replay.at("rewards", self.first), torch.ones_like(self.first)
        going = replay.at("valid", self.first) & ~self._ended(self.first)
        for _ in range(1, n):
            following = replay.after(self.last)
            going = going & (following // replay.rows != newest) & replay.at("valid", following)
            reward = replay.at("rewards", following) * gamma**self.steps
            self.rewards = self.rewards + reward.masked_fill(~going, 0.0)
            self.steps = self.steps + going
            self.last = torch.where(going, following, self.last)
            going = going & ~self._ended(self.last)

    def _ended(self, places: Tensor) -> Tensor:
        return self.replay.at("terminated", places) | (self.replay.at("cut", places) > 0)

    def take(self, batch: int) -> Transitions:
        """One batch of them, as transitions (B,)."""
        taken = self.replay.take(self.first[batch], self.last[batch])
        if self.rewards is None:
            return taken
        return replace(taken, rewards=self.rewards[batch], steps=self.steps[batch])

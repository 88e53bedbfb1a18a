"""A frozen policy that reads goals, for observations that hide them: a network predicts the missing entries."""

from typing import Any

import torch
from torch import Tensor, nn

from bidex_meta.training.learner import State

_FLOOR = 1e-5  # an entry whose standard deviation is not above this never varied in its class


class BorrowedPolicy(nn.Module):
    """Acts with another learner's policy on observations in which predicted entries show the goal.

    The statistics of each class's entries (``mean`` and ``std``, (K, e)) belong to the weights of the policy that
    borrows. The borrowed policy itself is passed to :meth:`lend`; it is not trained, and its weights are kept apart.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, classes: int, entries: int):
        super().__init__()
        self.register_buffer("mean", torch.zeros(classes, entries))
        self.register_buffer("std", torch.ones(classes, entries))
        self.state: State = {}

    def lend(self, policy: Any, state: State) -> None:
        """Set the borrowed policy.

        ``state`` has ``entries``, int64 (e,), which are the indices of the predicted entries; ``width``, the number of
        entries of an observation that the policy reads; ``more`` (K, m), what it reads after these for each class; and
        what is needed to load the policy again.
        """
        self.state = state
        # In a tuple, the policy is no submodule: optimisers and checkpoints of the borrower do not see its weights.
        self._lent = (policy, *(state[name].to(self.mean.device) for name in ("entries", "more")))

    def normalised(self, entries: Tensor, task: Tensor) -> tuple[Tensor, Tensor]:
        """Normalise entries (B, e) by their class ``task`` (B,); also return which entries vary in it, bool (B, e)."""
        std = self.std[task]
        return (entries - self.mean[task]) / std, std > 1.1 * _FLOOR

    def measure(self, mean: Tensor, std: Tensor) -> None:
        """Set the mean and the standard deviation of each class's entries, (K, e) each."""
        self.mean.copy_(mean)
        self.std.copy_(std.clamp_min(_FLOOR))

    def eval_action(self, obs: Tensor, predicted: Tensor, task: Tensor) -> Tensor:
        """Return the policy's actions (B, a) for raw observations (B, d) and normalised entries (B, e)."""
        policy, entries, more = self._lent
        shown = obs.index_add(1, entries, predicted.float() * self.std[task] + self.mean[task])
        return policy.eval_action(torch.cat([shown[:, : self.state["width"]], more[task]], dim=1))

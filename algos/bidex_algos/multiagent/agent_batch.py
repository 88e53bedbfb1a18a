"""One agent's share of a batch: what it saw, what it did, what it shall climb."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass
class AgentBatch:
    """Samples (B,) of one agent with a_i actions. Cut out of the batch once, so that mini-batches take rows alone."""

    seen: Tensor
    """What its network is fed (B, d_i)."""
    task: Tensor
    """The tasks' one-hot (B, heads); without columns where the agent has one head."""
    actions: Tensor
    """Its part of the sampled actions (B, a_i)."""
    old_means: Tensor
    """Of the sampling policy (B, a_i)."""
    old_log_std: Tensor
    """Of the sampling policy (B, a_i)."""
    old_log_probs: Tensor
    """Log-density of its part under the sampling policy (B,)."""
    gain: Tensor
    """The advantages it shall climb (B,)."""
    weights: Tensor
    """As in the batch (B,)."""

    def select(self, index: Tensor) -> "AgentBatch":
        """The samples at ``index``."""
        return AgentBatch(**{name: torch.index_select(value, 0, index) for name, value in vars(self).items()})

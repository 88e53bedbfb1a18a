"""The critics of the off-policy learners, values of actions, and how target networks follow."""

from typing import Any

import torch
from torch import Tensor, nn

from bidex_algos.nets.architecture import network_of
from bidex_algos.nets.inputs import Inputs


class Critics(nn.Module):
    """``count`` networks of observation and action, alike but for their initial weights.

    ``inputs`` are the groups of both together, ``heads`` the outputs of each, one per task or 1; ``config`` is a
    learner's (layers). Two against overestimation (Fujimoto et al. 2018), or one.
    """

    def __init__(self, inputs: int | Inputs, heads: int, config: Any, generator: torch.Generator, count: int = 2):
        super().__init__()
        self.heads = heads
        network = network_of(config)
        self.nets = nn.ModuleList(
            network(inputs, config.hidden, heads, 1.0, generator, config.activation, config.critic_layer_norm)
            for _ in range(count)
        )

    def forward(self, obs: Tensor, actions: Tensor, task_id: Tensor) -> Tensor:
        """Values of each action: normalised observations (B, d), actions (B, a), tasks (B,) to (count, B)."""
        x = torch.cat([obs, actions], dim=1)
        all_values = torch.stack([net(x) for net in self.nets])
        if self.heads == 1:
            return all_values.squeeze(2)
        return all_values.gather(2, task_id.expand(len(self.nets), -1)[..., None]).squeeze(2)


@torch.no_grad()
def follow(target: nn.Module, network: nn.Module, tau: float) -> None:
    """Moves a target network a share ``tau`` of the way to its network (Polyak averaging)."""
    for behind, ahead in zip(target.parameters(), network.parameters(), strict=True):
        behind.lerp_(ahead, tau)

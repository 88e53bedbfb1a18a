"""An actor without a distribution, and its agent (Silver et al. 2014)."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from bidex_algos.choices import Activation
from bidex_algos.nets.encoders.inputs import Inputs
from bidex_algos.nets.networks import MLP
from bidex_algos.nets.policy import ActorPolicy
from bidex_algos.nets.precision import autocast


class DeterministicActor(nn.Module):
    """One action for each observation, squashed by tanh.

    Args:
        inputs: The groups of the (normalised) observation, or its width.
        hidden: Widths of the hidden layers.
        actions: Number of actions.
        heads: Output layers; with more than one, the group ``task_id`` is the one-hot that chooses.
        generator: CPU generator of the initial weights.
        activation: Name of the non-linearity.
        network: What makes the network, by the arguments of ``MLP``.
    """

    def __init__(
        self,
        inputs: int | Inputs,
        hidden: Sequence[int],
        actions: int,
        heads: int,
        generator: torch.Generator,
        activation: Activation,
        network: Callable[..., Any] = MLP,
    ):
        super().__init__()
        self.heads = heads
        self.one_hot = Inputs.of(inputs).columns(*["task_id"] * (heads > 1))
        self.net = network(inputs, hidden, heads * actions, 0.01, generator, activation)

    def forward(self, x: Tensor) -> Tensor:
        """Actions of normalised observations (batch, d): float32 (batch, a) in [-1, 1]."""
        return torch.tanh(self.raw(x))

    def raw(self, x: Tensor) -> Tensor:
        """The same before the squashing: float32 (batch, a)."""
        out = self.net(x)
        if self.heads > 1:
            head = self.one_hot(x).argmax(1).view(-1, 1, 1)
            out = out.unflatten(1, (self.heads, -1))
            out = out.gather(1, head.expand(-1, 1, out.shape[2]))[:, 0]
        return out


class DeterministicPolicy(ActorPolicy):
    """A deterministic actor on raw observations; arguments are those of its base."""

    actor: DeterministicActor

    def raw(self, obs: Tensor) -> Tensor:
        """What tanh makes the actions of (N, a), for normalised observations (N, d), with their slopes."""
        with autocast(obs.device, self.low_precision):
            return self.actor.raw(obs)

    @torch.no_grad()
    def eval_action(self, obs: Tensor) -> Tensor:
        """The action for raw observations (N, d): (N, a) in [-1, 1]."""
        return torch.tanh(self.raw(self.observations(obs)))

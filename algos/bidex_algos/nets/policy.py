"""The agents for evaluation and sampling: observation statistics, actor and precision in one module."""

import math
from collections.abc import Sequence
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from bidex_algos.nets.architecture import network_of
from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import (
    MLP,
    Activation,
    GaussianActor,
    MakeNetwork,
    autocast,
    gaussian_log_prob,
    use_bfloat16,
)
from bidex_algos.nets.normalise import ObservationNormaliser, observation_normaliser
from bidex_algos.nets.shape import Shape


class ActorPolicy(nn.Module):
    """A normaliser and an actor on raw observations; an agent for evaluation, with ``eval_action``."""

    def __init__(self, observations: ObservationNormaliser, actor: nn.Module, low_precision: bool):
        super().__init__()
        self.observations = observations
        self.actor = actor
        self.low_precision = low_precision

    @classmethod
    def made_of(cls, actor: nn.Module, config: Any, inputs: Inputs, shape: Shape, device: torch.device) -> Self:
        """Make the policy of an actor, with the statistics and the precision that a learner's config requires."""
        observations = observation_normaliser(config, inputs, shape.num_id_columns)
        return cls(observations, actor, use_bfloat16(config.autocast, device))

    def reset(self, env_mask: Tensor) -> None:
        """Do nothing, because the policy has no state; the argument is part of the Agent protocol."""


class GaussianPolicy(ActorPolicy):
    """A Gaussian actor on raw observations; arguments as in the base class."""

    actor: GaussianActor

    @torch.no_grad()
    def distribution(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean action (N, a) and log standard deviation, (a,) or (N, a), for raw observations (N, d)."""
        obs = self.observations(obs)
        with autocast(obs.device, self.low_precision):
            return self.actor(obs), self.actor.log_std_of(obs)

    def eval_action(self, obs: Tensor) -> Tensor:
        """Return the mean action for raw observations (N, d), clamped to [-1, 1]: (N, a)."""
        return self.distribution(obs)[0].clamp(-1.0, 1.0)

    def sample_action(self, obs: Tensor, generator: torch.Generator) -> Tensor:
        """Sample actions from the distribution for raw observations (N, d), clamped to [-1, 1]: (N, a)."""
        mean, log_std = self.distribution(obs)
        noise = torch.randn(mean.shape, generator=generator, device=mean.device, dtype=mean.dtype)
        return (mean + log_std.exp() * noise).clamp(-1.0, 1.0)


def of_head(out: Tensor, head: Tensor) -> Tensor:
    """Select the outputs (B, ...) of one head for each sample from ``out`` (B, heads, ...).

    ``head``, int64 (B,), is the head of each sample.
    """
    return out.gather(1, head.view(-1, *[1] * (out.dim() - 1)).expand(-1, 1, *out.shape[2:]))[:, 0]


class DeterministicActor(nn.Module):
    """One action for each observation, squashed by tanh; arguments are those of :class:`GaussianActor`."""

    def __init__(
        self, inputs: int | Inputs, hidden: Sequence[int], actions: int, heads: int, generator: torch.Generator,
        activation: Activation, network: MakeNetwork = MLP
    ):  # fmt: skip
        super().__init__()
        self.heads = heads
        self.one_hot = Inputs.of(inputs).columns(*["task_id"] * (heads > 1))
        self.net = network(inputs, hidden, heads * actions, 0.01, generator, activation)

    def forward(self, x: Tensor) -> Tensor:
        """Return actions for normalised observations (batch, d): float32 (batch, a) in [-1, 1]."""
        return torch.tanh(self.raw(x))

    def raw(self, x: Tensor) -> Tensor:
        """Return the actions before squashing: float32 (batch, a)."""
        out = self.net(x)
        if self.heads == 1:
            return out
        return of_head(out.unflatten(1, (self.heads, -1)), self.one_hot(x).argmax(1))


class DeterministicPolicy(ActorPolicy):
    """A deterministic actor on raw observations."""

    actor: DeterministicActor

    def raw(self, obs: Tensor) -> Tensor:
        """Return the actions before squashing (N, a), with gradients, for normalised observations (N, d)."""
        with autocast(obs.device, self.low_precision):
            return self.actor.raw(obs)

    @torch.no_grad()
    def eval_action(self, obs: Tensor) -> Tensor:
        """Return the action for raw observations (N, d): (N, a) in [-1, 1]."""
        return torch.tanh(self.raw(self.observations(obs)))


def gaussian_policy(
    config: Any, inputs: Inputs, shape: Shape, init: torch.Generator, device: torch.device,
    make: type[GaussianActor] = GaussianActor
) -> GaussianPolicy:  # fmt: skip
    """Make a policy with the networks of a learner's config and weights from ``init``, a CPU generator."""
    if config.policy_heads:
        heads = shape.num_id_columns
    else:
        heads = 1
    network = network_of(config)
    actor = make(inputs, config.hidden, shape.actions, config.init_std, init, config.activation, heads, network)
    return GaussianPolicy.made_of(actor, config, inputs, shape, device)


def deterministic_policy(
    config: Any, inputs: Inputs, shape: Shape, init: torch.Generator, device: torch.device
) -> DeterministicPolicy:
    """Make a deterministic policy as in :func:`gaussian_policy`."""
    if config.policy_heads:
        heads = shape.num_id_columns
    else:
        heads = 1
    network = network_of(config)
    actor = DeterministicActor(inputs, config.hidden, shape.actions, heads, init, config.activation, network)
    return DeterministicPolicy.made_of(actor, config, inputs, shape, device)


def squashed_log_prob(raw: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Return the log-density of the action tanh(raw), with raw drawn from N(mean, exp(log_std)^2).

    ``raw`` (..., a) is the value before squashing, and the result is (...). The squashed action is not enough, because
    in float32 tanh rounds to 1 at 9 and above, and 1 has no finite inverse.
    """
    # This is log(1 - tanh(u)^2), written without a difference of almost equal numbers.
    log_slope = 2.0 * (math.log(2.0) - raw - softplus(-2.0 * raw))
    return gaussian_log_prob(raw, mean, log_std) - log_slope.sum(-1)


def sample_squashed(mean: Tensor, log_std: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Return actions (..., a) in [-1, 1] and their log-densities (...), from standard normal ``noise`` (..., a)."""
    raw = mean + log_std.exp() * noise
    return torch.tanh(raw), squashed_log_prob(raw, mean, log_std)


class SquashedActor(nn.Module):
    """Mean and log standard deviation, before squashing, from one network.

    A tanh keeps the log standard deviation between its bounds. With a hard clamp, a value beyond a bound would have no
    gradient and would never return.
    """

    def __init__(
        self, inputs: int | Inputs, hidden: Sequence[int], actions: int, heads: int, init_std: float,
        std_range: tuple[float, float], generator: torch.Generator, activation: Activation,
        network: MakeNetwork = MLP
    ):  # fmt: skip
        super().__init__()
        self.heads = heads
        self.one_hot = Inputs.of(inputs).columns(*["task_id"] * (heads > 1))
        low, high = (math.log(std) for std in std_range)
        self.middle = 0.5 * (low + high)
        self.reach = 0.5 * (high - low)
        self.net = network(inputs, hidden, heads * 2 * actions, 0.01, generator, activation)
        with torch.no_grad():
            start = math.atanh((math.log(init_std) - self.middle) / self.reach)
            self.net.output_bias.view(heads, 2, actions)[:, 1] = start

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log standard deviation for normalised observations (batch, d): float32 (batch, a) each."""
        out = self.net(x).unflatten(1, (self.heads, 2, -1))
        mean, log_std = (out[:, 0] if self.heads == 1 else of_head(out, self.one_hot(x).argmax(1))).unbind(1)
        return mean, self.middle + self.reach * torch.tanh(log_std)


class SquashedPolicy(ActorPolicy):
    """A squashed actor on raw observations; arguments as in the base class."""

    actor: SquashedActor

    def sample(self, obs: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Sample actions (N, a) and return their log-densities (N,) for normalised observations (N, d)."""
        with autocast(obs.device, self.low_precision):
            mean, log_std = self.actor(obs)
        noise = torch.randn(mean.shape, generator=generator, device=mean.device, dtype=mean.dtype)
        return sample_squashed(mean, log_std, noise)

    @torch.no_grad()
    def eval_action(self, obs: Tensor) -> Tensor:
        """Return the squashed mean for raw observations (N, d): (N, a) in [-1, 1]."""
        with autocast(obs.device, self.low_precision):
            mean, _ = self.actor(self.observations(obs))
        return torch.tanh(mean)

    @torch.no_grad()
    def sample_action(self, obs: Tensor, generator: torch.Generator) -> Tensor:
        """Sample actions from the distribution for raw observations (N, d): (N, a) in [-1, 1]."""
        return self.sample(self.observations(obs), generator)[0]


def squashed_policy(
    config: Any, inputs: Inputs, shape: Shape, init: torch.Generator, device: torch.device,
    network: MakeNetwork | None = None
) -> SquashedPolicy:  # fmt: skip
    """Make a squashed policy as in :func:`gaussian_policy`."""
    if config.policy_heads:
        heads = shape.num_id_columns
    else:
        heads = 1
    network = network or network_of(config)
    sizes = config.hidden, shape.actions, heads
    actor = SquashedActor(inputs, *sizes, config.init_std, config.std_range, init, config.activation, network)
    return SquashedPolicy.made_of(actor, config, inputs, shape, device)

"""The agents that evaluation and sampling use: observation statistics, actor and precision in one module."""

import torch
from torch import Tensor, nn

from bidex_algos.nets.networks import GaussianActor
from bidex_algos.nets.normalise import ObservationNormaliser
from bidex_algos.nets.precision import autocast


class ActorPolicy(nn.Module):
    """An actor on raw observations; with ``eval_action`` it follows the Agent protocol of evaluation.

    Args:
        observations: Normaliser of raw observations.
        actor: Network on normalised observations.
        low_precision: Whether hidden layers run in bfloat16.
    """

    def __init__(self, observations: ObservationNormaliser, actor: nn.Module, low_precision: bool):
        super().__init__()
        self.observations = observations
        self.actor = actor
        self.low_precision = low_precision

    def reset(self, env_mask: Tensor) -> None:
        """Nothing to forget between episodes; the argument is part of the Agent protocol."""


class GaussianPolicy(ActorPolicy):
    """A Gaussian actor on raw observations; arguments are those of its base."""

    actor: GaussianActor

    @torch.no_grad()
    def mean(self, obs: Tensor) -> Tensor:
        """Mean action of raw observations (N, d): float32 (N, a), not clamped."""
        return self.distribution(obs)[0]

    @torch.no_grad()
    def distribution(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean action (N, a) and logarithm of the standard deviation, (a,) or (N, a), of raw observations (N, d)."""
        obs = self.observations(obs)
        with autocast(obs.device, self.low_precision):
            return self.actor(obs), self.actor.log_std_of(obs)

    def eval_action(self, obs: Tensor) -> Tensor:
        """Mean action of raw observations (N, d), clamped to [-1, 1]: (N, a)."""
        return self.mean(obs).clamp(-1.0, 1.0)

    def sample_action(self, obs: Tensor, generator: torch.Generator) -> Tensor:
        """Actions drawn from the distribution for raw observations (N, d), clamped to [-1, 1]: (N, a)."""
        mean, log_std = self.distribution(obs)
        noise = torch.randn(mean.shape, generator=generator, device=mean.device, dtype=mean.dtype)
        return (mean + log_std.exp() * noise).clamp(-1.0, 1.0)

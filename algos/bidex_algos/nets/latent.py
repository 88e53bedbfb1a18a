"""A squashed policy that acts on a latent variable of the task, and the posterior of the latent given evidence."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import softplus

from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import MLP, Activation, autocast
from bidex_algos.nets.normalise import ObservationNormaliser
from bidex_algos.nets.policy import SquashedActor, SquashedPolicy

_NOT_IN_CONTEXT = ("right_hand", "left_hand", "padding", "task_id")
"""Groups that the encoder does not read. An encoder that reads the hands memorises fifty tasks and ignores rewards."""


class LatentPolicy(SquashedPolicy):
    """A policy whose ``actor`` reads normalised observations followed by a latent variable of ``size`` entries.

    The posterior is the unit Gaussian times one Gaussian factor per transition of the task. An ``encoder`` computes the
    factor from (s, a, r, s'). Two sums over the transitions therefore define the posterior: the sum of precisions and
    the sum of precisions times means. Both are 0 before the first transition.
    """

    def __init__(
        self, inputs: Inputs, actor: SquashedActor, low_precision: bool, normalise_observations: bool, actions: int,
        size: int, hidden: Sequence[int], reward_unit: float, generator: torch.Generator, activation: Activation
    ):  # fmt: skip
        super().__init__(ObservationNormaliser(inputs, normalise_observations), actor, low_precision)
        self.size = size
        self.reward_unit = reward_unit
        self.in_context = inputs.columns(*(group.name for group in inputs.groups if group.name not in _NOT_IN_CONTEXT))
        self.rewards = ObservationNormaliser(1)
        transition = 2 * self.in_context.size + actions + 1
        self.encoder = MLP(transition, hidden, 2 * size, 1.0, generator, activation)

    def compressed(self, reward: Tensor) -> Tensor:
        """Compress rewards (...) by asinh and return them as (..., 1), for the normaliser ``rewards``.

        Rewards are compressed because rewards of unknown classes differ by orders of magnitude.
        """
        return torch.asinh(reward / self.reward_unit)[..., None]

    def evidence(self, obs: Tensor, actions: Tensor, reward: Tensor, next_obs: Tensor) -> Tensor:
        """Return each transition's precision, and precision times mean, in one tensor (..., 2 * size).

        These are the terms that the transition adds to the two sums that define the posterior. Observations (..., d)
        and rewards (...) are raw.
        """
        before, after = (self.observations.some(self.in_context(x), self.in_context) for x in (obs, next_obs))
        seen = [before, actions, self.rewards(self.compressed(reward)), after]
        mean, raw = self.encoder(torch.cat(seen, dim=-1)).chunk(2, dim=-1)
        precision = softplus(raw)
        return torch.cat([precision, precision * mean], dim=-1)

    def posterior(self, sums: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation (..., size) of the latent variable from evidence sums (..., 2 * size)."""
        precision, weighted = sums.chunk(2, dim=-1)
        return weighted / (1.0 + precision), (1.0 + precision).rsqrt()

    def seen(self, obs: Tensor, latent: Tensor) -> Tensor:
        """Return the input of actor and critics, (N, d + size), for raw observations and the latent variable."""
        return torch.cat([self.observations(obs), latent], dim=1)

    @torch.no_grad()
    def latent_action(self, obs: Tensor, latent: Tensor) -> Tensor:
        """Return the squashed mean (N, a) in [-1, 1] for raw observations (N, d)."""
        with autocast(obs.device, self.low_precision):
            mean, _ = self.actor(self.seen(obs, latent))
        return torch.tanh(mean)

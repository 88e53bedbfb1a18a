"""IQL: values computed only from actions of the data (Kostrikov et al. 2022; Bi-DexHands' appendix B.3.3).

V minimises |t - 1(u < 0)| u^2 with u = min_i Q'_i(s, a) - V(s), so V is the t-expectile over the data's actions. pi
maximises min(exp(beta u), bound) log pi(a | s). Q_i regresses to r + gamma (1 - terminated) V(s').
"""

from dataclasses import dataclass
from functools import partial
from typing import Annotated

import torch
from msgspec import Meta
from torch import Tensor

from bidex_algos.nets.architecture import follow
from bidex_algos.nets.networks import GaussianActor, autocast, gaussian_log_prob
from bidex_algos.nets.policy import GaussianPolicy, gaussian_policy
from bidex_algos.offline.base import PAPER, CriticConfig, Offline
from bidex_algos.replay import Transitions
from bidex_meta.training.learner import NO_SOURCES, Parts, Sources
from bidex_meta.utils.validation import NonNegative, Positive, check_rising, check_within
from bidex_meta.world.contract import VectorWorld


@dataclass(frozen=True)
class IQLConfig(CriticConfig):
    """All options of IQL; the defaults are the preset ``laptop``."""

    expectile: Annotated[float, Meta(gt=0.0, lt=1.0)] = 0.7
    """The value of a state is this expectile of the values of the data's actions: 0.5 is their mean; the nearer to 1,
    the nearer to the best value."""
    beta: NonNegative = 3.0  # The weight of an action in the actor's update is exp(beta * advantage); 0: all equal.
    max_weight: Positive = 100.0  # Upper bound of an action's weight in the actor's update.
    init_std: Positive = 1.0  # Initial standard deviation of the actor.
    std_range: tuple[Positive, Positive] = (0.0067, 7.4)  # Bounds of the standard deviation: exp(-5) and exp(2).

    def __post_init__(self) -> None:
        super().__post_init__()
        check_rising(self, self.algo, "std_range")
        check_within(self, self.algo, "init_std", "std_range")


# The defaults are from Table 46. The bound of the weight is from Kostrikov et al. (2022, their code).
PRESETS: dict[str, IQLConfig] = {"paper": IQLConfig(normalise_observations=False, **PAPER), "laptop": IQLConfig()}


class BoundedMean(GaussianActor):
    """A Gaussian whose mean is squashed by tanh; arguments as in the base class."""

    def forward(self, x: Tensor) -> Tensor:
        """Return the mean action for normalised observations (batch, d): float32 (batch, a) in [-1, 1]."""
        return torch.tanh(super().forward(x))


class IQL(Offline):
    """Implicit Q-learning on data sets (Kostrikov et al. 2022, arXiv 2110.06169)."""

    name = "iql"
    remedy = "lower beta"
    config_type = IQLConfig
    presets = PRESETS
    config: IQLConfig
    policy: GaussianPolicy
    policy_of = staticmethod(partial(gaussian_policy, make=BoundedMean))

    def __init__(self, world: VectorWorld, config: IQLConfig, seed: int, sources: Sources = NO_SOURCES):
        super().__init__(world, config, seed, sources)
        self.value = self._critics(self.inputs, self.critic.heads, 1)
        self.adams["value"] = self._adam(self.value.parameters(), config.critic_learning_rate)
        self.log_bounds = [float(torch.tensor(std).log()) for std in config.std_range]

    def _update(self, draw: Transitions) -> dict[str, Tensor]:
        obs = self.policy.observations(draw.obs)
        next_obs = self.policy.observations(draw.next_obs)
        with torch.no_grad():
            judged = self._values(self.target_critic, obs, draw.actions).amin(0)
        ahead = judged - self._worth(obs)
        loss = expectile_loss(ahead, self.config.expectile).mean()
        self._descend(loss, "value", self.value)
        with torch.no_grad():
            advantage = judged - self._worth(obs)
            target = self._bootstrapped(draw, self._worth(next_obs))
        reported = {"Loss/value": loss.detach()} | self._fit_actor(obs, draw.actions, advantage)
        reported |= self._fit_critics(obs, draw, target)
        follow(self.target_critic, self.critic, self.config.tau)
        return reported

    def _worth(self, obs: Tensor) -> Tensor:
        return self._values(self.value, obs, obs[:, :0])[0]

    def _fit_actor(self, obs: Tensor, actions: Tensor, advantage: Tensor) -> dict[str, Tensor]:
        weight = (self.config.beta * advantage).exp().clamp_max(self.config.max_weight)
        with autocast(self.device, self.low_precision):
            mean = self.policy.actor(obs)
            log_std = self.policy.actor.log_std_of(obs)
        loss = -(weight * gaussian_log_prob(actions, mean, log_std)).mean()
        self._descend(loss, "actor", self.policy.actor)
        with torch.no_grad():
            self.policy.actor.log_std.clamp_(*self.log_bounds)
        std = log_std.detach().exp().mean()
        return {"Loss/actor": loss.detach(), "Policy/std": std, "Policy/weight": weight.mean()}

    def _own_parts(self) -> Parts:
        return {"value": self.value}


def expectile_loss(ahead: Tensor, expectile: float) -> Tensor:
    """Return |t - 1(u < 0)| u^2 for each difference u in ``ahead``, in the shape of ``ahead``; t is ``expectile``.

    If u = x - v, the mean loss over all x is smallest if v is the t-expectile of x.
    """
    return torch.where(ahead < 0.0, 1.0 - expectile, expectile) * ahead.square()

"""TD3+BC: TD3 on stored transitions, with an actor that stays near the data (Fujimoto and Gu 2021).

The targets and the delay of the actor's updates are TD3's. The actor mu minimises (mu(s) - a)^2 - lambda Q_1(s, mu(s)),
with lambda = alpha / mean |Q_1(s, mu(s))|. Bi-DexHands describes TD3+BC in appendix B.3.2.
"""

import copy
from dataclasses import dataclass

import torch
from torch import Tensor

from bidex_algos.nets.architecture import follow
from bidex_algos.nets.networks import autocast
from bidex_algos.offline.base import PAPER, CriticConfig
from bidex_algos.offline.bc import BC
from bidex_algos.replay import Transitions
from bidex_meta.training.learner import NO_SOURCES, Parts, Sources
from bidex_meta.utils.validation import Count, NonNegative
from bidex_meta.world.contract import VectorWorld


@dataclass(frozen=True)
class TD3BCConfig(CriticConfig):
    """All options of TD3+BC; the defaults are the preset ``laptop``."""

    alpha: NonNegative = 2.5
    """Weight of the value relative to the squared distance to the data's action. The value is divided by its mean
    absolute value in the batch. 0: behaviour cloning."""
    target_std: NonNegative = 0.2  # Standard deviation of the noise on the target actor's actions.
    target_bound: NonNegative = 0.5  # The noise on the target actor's actions is clipped to plus and minus this value.
    policy_delay: Count = 2  # Updates of the critics for each update of the actor and the target networks.


# "paper": alpha is from Table 46, whose other numbers are the defaults. The table omits noise, its bound and the delay;
# these values, and alpha of "laptop", are from Fujimoto and Gu (2021, table 3), who also normalise observations.
PRESETS: dict[str, TD3BCConfig] = {"paper": TD3BCConfig(alpha=0.2, **PAPER), "laptop": TD3BCConfig()}


class TD3BC(BC):
    """TD3+BC on data sets (Fujimoto and Gu 2021, arXiv 2106.06860)."""

    name = "td3bc"
    remedy = "lower critic_learning_rate"
    config_type = TD3BCConfig
    presets = PRESETS
    config: TD3BCConfig  # pyright: ignore[reportIncompatibleVariableOverride]
    num_critics = 2

    def __init__(self, world: VectorWorld, config: TD3BCConfig, seed: int, sources: Sources = NO_SOURCES):
        super().__init__(world, config, seed, sources)
        self.target_actor = copy.deepcopy(self.policy.actor)

    def _update(self, draw: Transitions) -> dict[str, Tensor]:
        obs = self.policy.observations(draw.obs)
        next_obs = self.policy.observations(draw.next_obs)
        reported = self._fit_critics(obs, draw, self._target(draw, next_obs))
        if self.env_steps % self.config.policy_delay == 0:
            reported |= self._fit_actor(obs, draw)
            follow(self.target_actor, self.policy.actor, self.config.tau)
            follow(self.target_critic, self.critic, self.config.tau)
        return reported

    @torch.no_grad()
    def _target(self, draw: Transitions, next_obs: Tensor) -> Tensor:
        with autocast(self.device, self.low_precision):
            action = self.target_actor(next_obs)
        bound = self.config.target_bound
        noise = (self.config.target_std * self._normal(action)).clamp(-bound, bound)
        following = self._values(self.target_critic, next_obs, (action + noise).clamp(-1.0, 1.0))
        return self._bootstrapped(draw, following.amin(0))

    def _actor_loss(self, imitation: Tensor, obs: Tensor, actions: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        value = self._values(self.critic, obs, actions)[0]
        weight = self.config.alpha / value.detach().abs().mean().clamp_min(1e-8)
        loss = imitation - weight * value.mean()
        return loss, {"Loss/actor": loss.detach()}

    def _begin_targets(self) -> None:
        self.target_actor.load_state_dict(self.policy.actor.state_dict())

    def _own_parts(self) -> Parts:
        return {"target_actor": self.target_actor}

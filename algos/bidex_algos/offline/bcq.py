"""BCQ: values of actions that a model of the data proposes (Fujimoto et al. 2019; appendix B.3.1).

G    down on |G(s, z) - a|^2 + KL, z the code of a                     the data's actions
a'_j = G(s', z_j) + xi'(s', G(s', z_j)),  j = 1...n, |xi'| <= Phi
y    = r + gamma (1 - terminated) max_j [w min_i + (1 - w) max_i] Q'_i(s', a'_j)
Q_i  towards y
xi   up on Q_1(s, a + xi(s, a)), a = G(s, z)
Q', xi'  a small step towards Q, xi
"""

import copy
from typing import Any

import torch
from torch import Tensor

from bidex_algos.experience.replay import Transitions
from bidex_algos.nets.precision import autocast, use_bfloat16
from bidex_algos.nets.shape import Shape
from bidex_algos.offline.base import Offline
from bidex_algos.offline.bcq_config import PRESETS, BCQConfig
from bidex_algos.offline.bcq_policy import BCQPolicy, bounded
from bidex_algos.offpolicy.critics import follow
from bidex_meta.world.contract import VectorWorld

__all__ = ["BCQ", "PRESETS", "BCQConfig"]


class BCQ(Offline):
    """Batch-constrained deep Q-learning on data sets (Fujimoto et al. 2019, arXiv 1812.02900).

    Arguments, errors and attributes are those of :class:`~bidex_algos.offline.base.Offline`.

    Attributes:
        target_actor: Follows the network that changes proposals.
    """

    name, remedy = "bcq", "lower critic_learning_rate"
    config_type = BCQConfig
    config: BCQConfig
    policy: BCQPolicy

    def __init__(self, world: VectorWorld, config: BCQConfig, seed: int):
        super().__init__(world, config, seed)
        self.target_actor = copy.deepcopy(self.policy.actor)
        self.adams["model"] = self._adam(self.policy.model.parameters(), config.vae_learning_rate)

    def _make_critics(self) -> Any:
        return self.policy.critic

    def _update(self, draw: Transitions) -> dict[str, Tensor]:
        obs, next_obs = self.policy.observations(draw.obs), self.policy.observations(draw.next_obs)
        told = self._fit_model(obs, draw.actions)
        told |= self._fit_critics(obs, draw, self._target(draw, next_obs))
        told |= self._fit_actor(obs)
        follow(self.target_critic, self.critic, self.config.tau)
        follow(self.target_actor, self.policy.actor, self.config.tau)
        return told

    def _fit_model(self, obs: Tensor, actions: Tensor) -> dict[str, Tensor]:
        """One step of the model towards the data's actions (B, a)."""
        model = self.policy.model
        with autocast(self.device, self.low_precision):
            mean, log_std = model.encode(obs, actions)
            again = model.decode(obs, mean + log_std.exp() * self._normal(mean))
        error = (again - actions).square().mean()
        divergence = (0.5 * ((2.0 * log_std).exp() + mean.square() - 1.0) - log_std).mean()
        self._descend(error + self.config.kl_weight * divergence, "model", model)
        return {"Loss/reconstruction": error.detach(), "Loss/divergence": divergence.detach()}

    @torch.no_grad()
    def _target(self, draw: Transitions, next_obs: Tensor) -> Tensor:
        """What the critics shall say of the drawn transitions (B,); ``next_obs`` are normalised."""
        count = self.config.candidates
        many, task = next_obs.repeat_interleave(count, 0), self.task_of_draw.repeat_interleave(count)
        codes = bounded(self._normal(many.new_empty(len(many), self.policy.model.codes)))
        with autocast(self.device, self.low_precision):
            values = self.target_critic(many, self.policy.propose(self.target_actor, many, codes), task)
        return self._bootstrapped(draw, best_of(values, count, self.config.lower_weight))

    def _fit_actor(self, obs: Tensor) -> dict[str, Tensor]:
        """One step of the changes up the first critic, at one proposal for each state."""
        policy = self.policy
        with autocast(self.device, self.low_precision):
            with torch.no_grad():
                proposed = policy.model.decode(obs, bounded(self._normal(obs.new_empty(len(obs), policy.model.codes))))
            changed = policy.changed(policy.actor, obs, proposed)
        loss = -self._values(self.critic, obs, changed)[0].mean()
        self._descend(loss, "actor", policy.actor)
        return {"Loss/actor": loss.detach()}

    @classmethod
    def _make_policy(cls, config: BCQConfig, shape: Shape, init: torch.Generator, device: torch.device) -> BCQPolicy:
        low_precision = use_bfloat16(config.autocast, device)
        return BCQPolicy(config, cls._inputs(config, shape), shape, init, low_precision).to(device)

    def _parts(self) -> dict[str, Any]:
        parts = super()._parts()
        del parts["critic"]  # the policy's
        return parts

    def _own_parts(self) -> dict[str, Any]:
        return {"target_actor": self.target_actor}


def best_of(values: Tensor, count: int, lower_weight: float) -> Tensor:
    """The best proposal's value of each state (B,).

    Args:
        values: Of both critics, ``count`` proposals of each state behind one another, (2, B * count).
        count: Proposals of a state.
        lower_weight: Weight of the lower critic; the higher one has the rest.
    """
    mixed = lower_weight * values.amin(0) + (1.0 - lower_weight) * values.amax(0)
    return mixed.view(-1, count).amax(1)

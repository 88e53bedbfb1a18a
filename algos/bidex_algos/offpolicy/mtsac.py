"""MT-SAC: soft actor-critic (Haarnoja et al. 2018) on all tasks of a world at once, with a temperature for each.

For each vector step of the world::

    a = tanh(u), u ~ N(mean, std)(s)             one step in every row; into the replay
    y = r + gamma (1 - terminated) (min_i Q'_i(s', a') - alpha_k log pi(a'|s'))
    Q_i  towards y                               i = 1, 2; on equally many transitions of each task k
    pi   down on alpha_k log pi(a|s) - min_i Q_i(s, a)
    log alpha_k  down on -log alpha_k (log pi(a|s) + H)      the mean over task k alone
    Q'_i  a small step towards Q_i

The target entropy H is ``target_entropy_per_action`` times the number of actions: Haarnoja's -dim(A) by default. One
temperature for all would be set by their mean entropy: a task that is solved and one that still explores need
different ones ("disentangled alphas"). The loss of log alpha is linear in log alpha rather than in alpha, so that its
gradient is the gap in entropy whatever alpha is. Deviations stand in ``docs/learners/mtsac.md``.
"""

import math
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from bidex_algos.experience.replay import Transitions
from bidex_algos.nets.multitask.architecture import network_of
from bidex_algos.nets.networks import MLP
from bidex_algos.nets.normalise import ObservationNormaliser
from bidex_algos.nets.precision import use_bfloat16
from bidex_algos.nets.shape import Shape
from bidex_algos.nets.squashed import SquashedActor, SquashedPolicy
from bidex_algos.offpolicy.base import OffPolicy
from bidex_algos.offpolicy.critics import follow
from bidex_algos.offpolicy.mtsac_config import PRESETS, MTSACConfig
from bidex_meta.world.contract import VectorWorld

__all__ = ["MTSAC", "PRESETS", "MTSACConfig"]


class MTSAC(OffPolicy):
    """Multi-task SAC (Haarnoja et al. 2018, arXiv 1812.05905) on a batched world.

    Arguments and errors are those of :class:`~bidex_algos.offpolicy.base.OffPolicy`, so are the attributes.

    Attributes:
        policy: The agent that evaluation uses: squashed mean.
        log_alpha: Logarithms of the temperatures (num_tasks,).
    """

    name, remedy = "mtsac", "lower critic_learning_rate"
    config_type = MTSACConfig
    config: MTSACConfig
    policy: SquashedPolicy
    actor_network: ClassVar[type[MLP] | None] = None

    def __init__(self, world: VectorWorld, config: MTSACConfig, seed: int):
        super().__init__(world, config, seed)
        self.log_alpha = nn.Parameter(torch.full((world.num_tasks,), math.log(config.init_alpha), device=self.device))
        self.target_entropy = config.target_entropy_per_action * self.shape.actions
        self.adams["alpha"] = self._adam([self.log_alpha], config.alpha_learning_rate, decay=0.0)

    def _explore(self, obs: Tensor) -> Tensor:
        return self.policy.sample(self.policy.observations(obs), self.generator)[0]

    def _update(self, draw: Transitions, weights: Tensor, counts: Tensor) -> dict[str, Tensor]:
        """One update of critics, actor, temperatures and target critics; losses, entropy and values."""
        obs, next_obs = self.policy.observations(draw.obs), self.policy.observations(draw.next_obs)
        told = self._fit_critics(obs, draw, self._target(draw, next_obs), weights, counts)
        told |= self._policy_step(obs, weights, counts)
        follow(self.target_critic, self.critic, self.config.tau)
        return told

    @torch.no_grad()
    def _target(self, draw: Transitions, next_obs: Tensor) -> Tensor:
        """What the critics shall say of the drawn transitions (B,); ``next_obs`` are normalised."""
        next_actions, log_prob = self.policy.sample(next_obs, self.generator)
        following = self._pooled(self._values(self.target_critic, next_obs, next_actions))
        return self._bootstrapped(draw, following - self.log_alpha.exp()[self.task_of_draw] * log_prob)

    def _policy_step(self, obs: Tensor, weights: Tensor, counts: Tensor) -> dict[str, Tensor]:
        """One step of actor and temperatures, on normalised observations (B, d)."""
        weight = weights / counts.sum().clamp_min(1.0)
        actions, log_prob = self.policy.sample(obs, self.generator)
        alpha = self.log_alpha.detach().exp()[self.task_of_draw]
        actor_loss = (weight * (alpha * log_prob - self._pooled(self._values(self.critic, obs, actions)))).sum()
        gap = self._per_task(weights * (log_prob.detach() + self.target_entropy)) / counts.clamp_min(1.0)
        alpha_loss = -(self.log_alpha * self._gap_that_counts(gap)).sum()
        entropy = -(weight * log_prob.detach()).sum()
        numbers = torch.stack([actor_loss.detach(), entropy])
        actor = list(self.policy.actor.parameters())
        numbers = self._descend(actor_loss + alpha_loss, numbers, "actor", actor=actor, alpha=[self.log_alpha])
        return dict(zip(["Loss/actor", "Policy/entropy"], numbers, strict=True))

    def _gap_that_counts(self, gap: Tensor) -> Tensor:
        """The gap in entropy that each task's temperature follows, of the tasks' own (num_tasks,)."""
        return gap

    def _told(self) -> dict[str, Tensor]:
        alphas = self.log_alpha.detach().exp()
        return {f"Policy/alpha/{name}": alpha for name, alpha in zip(self.world.task_names, alphas, strict=True)}

    @classmethod
    def _make_policy(
        cls, config: MTSACConfig, shape: Shape, init: torch.Generator, device: torch.device
    ) -> SquashedPolicy:
        inputs, heads = cls._inputs(config, shape), shape.num_id_columns if config.policy_heads else 1
        sizes, network = (config.hidden, shape.actions, heads), cls.actor_network or network_of(config)
        actor = SquashedActor(inputs, *sizes, config.init_std, config.std_range, init, config.activation, network)
        observations = ObservationNormaliser(inputs, config.normalise_observations)
        return SquashedPolicy(observations, actor, use_bfloat16(config.autocast, device)).to(device)

    def _own_parts(self) -> dict[str, Any]:
        return {"log_alpha": self.log_alpha}

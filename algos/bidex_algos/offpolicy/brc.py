"""BRC: "bigger, regularised, categorical" (Nauman et al. 2025, arXiv 2505.23150): SAC on all tasks by one large critic.

    a' = tanh(u), u ~ N(mean, std)(s')
    y  = r + gamma (1 - terminated) (Z'(s', a') - alpha log pi(a'|s'))     Z': the mean of both critics' distributions
    Z_i  towards y by cross-entropy: wide residual networks with layer norm, weights decay
    pi   down on alpha log pi(a|s) - mean_i E Z_i(s, a)
    rewards over their task's largest return, so that all tasks fill the same atoms (the paper's equation 2)

The task enters by a learned vector of length 1. The critic has the capacity, the actor is small; no critic is
pessimistic. All else is as in ``mtsac.py`` and ``categorical.py``; deviations stand in ``docs/learners/brc.md``.
"""

import torch
from torch import Tensor

from bidex_algos.experience.advantages import discounts
from bidex_algos.experience.replay import Transitions
from bidex_algos.nets.encoders.inputs import Inputs
from bidex_algos.nets.encoders.point_net import with_point_net
from bidex_algos.nets.encoders.task_embedding import with_task_embedding
from bidex_algos.nets.residual import ResidualMLP
from bidex_algos.nets.shape import Shape
from bidex_algos.offpolicy.brc_config import PRESETS, BRCConfig
from bidex_algos.offpolicy.categorical import Categorical
from bidex_algos.offpolicy.mtsac import MTSAC

__all__ = ["BRC", "PRESETS", "BRCConfig"]


class BRC(Categorical, MTSAC):
    """BRC (Nauman et al. 2025, arXiv 2505.23150) on a batched world.

    Arguments, errors and attributes are those of :class:`~bidex_algos.offpolicy.mtsac.MTSAC`.
    """

    name = "brc"
    config_type = BRCConfig
    config: BRCConfig
    actor_network = critic_network = ResidualMLP

    @classmethod
    def _inputs(cls, config: BRCConfig, shape: Shape) -> Inputs:
        return with_task_embedding(
            with_point_net(Inputs(shape.groups), config), cls._embedded(config, shape), unit=True
        )

    @torch.no_grad()
    def _target(self, draw: Transitions, next_obs: Tensor) -> Tensor:
        """What the critics shall say of the drawn transitions (B, atoms); ``next_obs`` are normalised."""
        next_actions, log_prob = self.policy.sample(next_obs, self.generator)
        bonus = -self.log_alpha.exp()[self.task_of_draw] * log_prob
        return self._projected(draw, self._following(next_obs, next_actions), bonus)

    def _reward_scale(self) -> Tensor:
        if not self.config.per_task_rewards:
            return super()._reward_scale()
        tasks = torch.arange(self.world.num_tasks, device=self.device)
        gamma = discounts(self.world, self.config.gamma, tasks)
        bound, each = self.config.value_bound, abs(self.target_entropy) / (1.0 - gamma)
        # Room for the entropy of all steps to come, but half of the atoms are the rewards' in any case.
        room = bound - (self.log_alpha.detach().exp() * each).clamp_max(0.5 * bound)
        return (self.returns.bound / room).clamp_min(1e-8)

    def _gap_that_counts(self, gap: Tensor) -> Tensor:
        return gap.mean().expand_as(gap) if self.config.one_temperature else gap

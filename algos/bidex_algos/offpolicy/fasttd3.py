"""FastTD3: TD3 with categorical critics and large batches (Seo et al. 2025, arXiv 2505.22642), on all tasks of a world.

    a  = mu(s) + noise                           of another size in each row ("mixed noise")
    a' = mu(s') + clip(noise, -c, c)             the present actor's: none follows it
    y  = r + gamma (1 - terminated) Z'(s', a')   of the critic with the lower mean, projected on the atoms
    Z_i  towards y by cross-entropy; mu up on min_i E Z_i(s, mu(s)), at every second update; Z' at each
    rewards over max(deviation, largest / bound) of their task's returns, so that values fit the atoms

Few updates of many transitions follow each vector step, targets follow fast, returns may take several steps (n-step),
weights decay. All else is as in ``td3.py`` and ``categorical.py``; deviations stand in ``docs/learners/fasttd3.md``.
"""

import torch
from torch import Tensor

from bidex_algos.experience.replay import Transitions
from bidex_algos.offpolicy.categorical import Categorical
from bidex_algos.offpolicy.fasttd3_config import PRESETS, FastTD3Config
from bidex_algos.offpolicy.td3 import TD3

__all__ = ["PRESETS", "FastTD3", "FastTD3Config"]


class FastTD3(Categorical, TD3):
    """Multi-task FastTD3 (Seo et al. 2025, arXiv 2505.22642) on a batched world.

    Arguments, errors and attributes are those of :class:`~bidex_algos.offpolicy.td3.TD3`.
    """

    name = "fasttd3"
    config_type = FastTD3Config
    config: FastTD3Config
    delayed_targets = False

    @torch.no_grad()
    def _target(self, draw: Transitions, next_obs: Tensor) -> Tensor:
        """What the critics shall say of the drawn transitions (B, atoms); ``next_obs`` are normalised."""
        following = self._following(next_obs, self._target_action(next_obs))
        return self._projected(draw, following, torch.zeros_like(draw.rewards))

    def _climbed(self, values: Tensor) -> Tensor:
        return self._pooled(values)

    def _reward_scale(self) -> Tensor:
        if not self.config.per_task_rewards:
            return super()._reward_scale()
        return torch.maximum(self.returns.deviation(), self.returns.bound / self.config.value_bound)

"""FastTD3: TD3 with categorical critics and large batches (Seo et al. 2025, arXiv 2505.22642), on all tasks of a world.

Few updates of many transitions follow each vector step. Targets use the present actor's actions, and target networks
follow fast. mu climbs min_i E Z_i, returns may span several steps, and weights decay. Rewards are divided by
max(standard deviation, largest / bound) of their task's returns. The rest is described in ``td3.py`` and
``categorical.py``; see ``docs/learners/fasttd3.md``.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from bidex_algos.offpolicy.categorical import Categorical, CategoricalConfig
from bidex_algos.offpolicy.td3 import TD3, TD3Config
from bidex_algos.replay import Transitions
from bidex_meta.utils.validation import Count, NonNegative, Share


@dataclass(frozen=True)
class FastTD3Config(CategoricalConfig, TD3Config):
    """All options of FastTD3; the defaults are the preset ``laptop``."""

    value_heads: bool = False  # Give each critic one distribution per task instead of one for all.
    n_steps: Count = 3  # Steps whose rewards a target takes as they came, before it asks for the value of what follows.
    tau: Share = 0.05  # Share of the critics that enters the target critics in each update (1 - Polyak's factor).
    weight_decay: NonNegative = 0.1  # Share of its step size by which a step shortens all weights (AdamW).


PRESETS: dict[str, FastTD3Config] = {
    # The values are from the authors' code (github.com/younggyoseo/FastTD3, fast_td3/hyperparams.py and fast_td3.py,
    # 2025), because the paper has no complete table. Replay, discount, steps, bound and scaled rewards are from its
    # class for several tasks (MTBenchArgs, MetaWorldMT10Args). The rest are its defaults (BaseArgs), whose gradient
    # norm of 0 means no limit. replay_memory holds these steps of its 4,096 environments, with 441 columns.
    "paper": FastTD3Config(
        hidden=(512, 256, 128), critic_hidden=(1024, 512, 256), critic_layer_norm=False, task_embedding=32,
        replay_steps=2048, replay_memory=18.0, warmup_steps=10, updates_per_step=2, batch_size=32_768, gamma=0.97,
        n_steps=8, tau=0.1, learning_rate=3e-4, critic_learning_rate=3e-4, weight_decay=0.1, max_grad_norm=1e9,
        atoms=101, value_bound=10.0, exploration_std=(0.001, 0.4), target_std=0.001, target_bound=0.5, policy_delay=2,
        squash_price=0.0,
    ),
    "laptop": FastTD3Config(),
    # For Meta-World's suites on one core: discount, steps and bound are from the authors' class for these suites.
    # Layers are narrower and there is one update of fewer transitions, because a vector step has 4 rows per class here
    # instead of hundreds.
    "metaworld": FastTD3Config(
        hidden=(256, 256, 128), critic_hidden=(256, 256, 128), replay_steps=100_000, warmup_steps=500,
        steps_per_iteration=500, updates_per_step=1, batch_per_task=256, gamma=0.97, n_steps=8, tau=0.05,
        exploration_std=(0.05, 0.4), squash_price=0.1,
    ),
}  # fmt: skip


class FastTD3(Categorical, TD3):
    """Multi-task FastTD3 (Seo et al. 2025, arXiv 2505.22642) on a batched world."""

    name = "fasttd3"
    config_type = FastTD3Config
    presets = PRESETS
    config: FastTD3Config
    delayed_targets = False

    @torch.no_grad()
    def _target(self, draw: Transitions, next_obs: Tensor) -> Tensor:
        following = self._following(next_obs, self._target_action(next_obs))
        return self._projected(draw, following, torch.zeros_like(draw.rewards))

    def _climbed(self, values: Tensor) -> Tensor:
        return self._pooled(values)

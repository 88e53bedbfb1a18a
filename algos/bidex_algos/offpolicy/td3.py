"""TD3: DDPG with three changes (Fujimoto et al. 2018; Bi-DexHands' appendix B.1.4), on all tasks of a world at once.

Targets are smoothed over actions, a' = mu'(s') + clip(noise, -c, c), and use the lower of two critics. The actor and
all target networks move only at every second update of the critics.
"""

from dataclasses import dataclass

from torch import Tensor

from bidex_algos.offpolicy.ddpg import DDPG, OF_PAPER, DDPGConfig
from bidex_meta.utils.validation import Count, NonNegative
from bidex_meta.world.contract import VectorWorld


@dataclass(frozen=True)
class TD3Config(DDPGConfig):
    """All options of TD3; the defaults are the preset ``laptop``."""

    target_std: NonNegative = 0.2  # Standard deviation of the noise on the next actions in targets.
    target_bound: NonNegative = 0.5  # The noise in targets is clipped to plus and minus this value.
    policy_delay: Count = 2  # Updates of the critics for each update of the actor and of all target networks.


# Smoothing and delay of "paper" and of the defaults are from Fujimoto et al. (2018, section 6.1).
PRESETS: dict[str, TD3Config] = {
    "paper": TD3Config(**OF_PAPER),
    "laptop": TD3Config(),
    # This preset is for Meta-World's suites. Discount, Polyak factor, layers, replay and batches are from MT-SAC's
    # preset of this name.
    "metaworld": TD3Config(
        hidden=(400, 400, 400), replay_steps=100_000, warmup_steps=500, steps_per_iteration=500, updates_per_step=1,
        batch_per_task=128, gamma=0.99, tau=0.005, learning_rate=3e-4, critic_learning_rate=3e-4,
        exploration_std=(0.1, 0.4), squash_price=0.1,
    ),
}  # fmt: skip


class TD3(DDPG):
    """Multi-task TD3 (Fujimoto et al. 2018, arXiv 1802.09477) on a batched world."""

    name = "td3"
    config_type = TD3Config
    presets = PRESETS
    config: TD3Config
    num_critics = 2
    going_on = ("updates", *DDPG.going_on)

    def __init__(self, world: VectorWorld, config: TD3Config, seed: int):
        super().__init__(world, config, seed)
        self.updates = 0

    def _actor_is_due(self) -> bool:
        self.updates += 1
        return self.updates % self.config.policy_delay == 0

    def _target_action(self, next_obs: Tensor) -> Tensor:
        action = super()._target_action(next_obs)
        bound = self.config.target_bound
        noise = self.config.target_std * self._normal(action)
        return (action + noise.clamp(-bound, bound)).clamp(-1.0, 1.0)

"""What can be set about TD3, and its presets; imports no torch, so that a command line can show it at once."""

from dataclasses import dataclass
from typing import ClassVar

from bidex_algos.checks import at_least
from bidex_algos.offpolicy.ddpg_config import DDPGConfig, of_paper


@dataclass(frozen=True)
class TD3Config(DDPGConfig):
    """Everything that can be set about TD3; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "td3"

    target_std: float = 0.2
    """Standard deviation of the noise on the actions that targets assume."""
    target_bound: float = 0.5
    """That noise is cut to plus and minus this."""
    policy_delay: int = 2
    """Updates of the critics for each of the actor and of what follows them (FastTD3's target critics: at each)."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        super().__post_init__()
        at_least(self, 0, "target_std", "target_bound")
        at_least(self, 1, "policy_delay")


# Smoothing and delay of "paper" are those of Fujimoto et al. (2018, section 6.1), as are the defaults.
PRESETS: dict[str, TD3Config] = {
    "paper": TD3Config(**of_paper()),
    "laptop": TD3Config(),
    # Meta-World's suites: discount, Polyak, layers, replay and batches are those of MT-SAC's preset of that name.
    "metaworld": TD3Config(
        hidden=(400, 400, 400), replay_steps=100_000, warmup_steps=500, steps_per_iteration=500, updates_per_step=1,
        batch_per_task=128, gamma=0.99, tau=0.005, learning_rate=3e-4, critic_learning_rate=3e-4,
        exploration_std=(0.1, 0.4), squash_price=0.1,
    ),
}  # fmt: skip

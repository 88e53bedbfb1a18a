"""What can be set about MT-SAC, and its presets; imports no torch, so that a command line can show it at once."""

from dataclasses import dataclass, replace
from typing import ClassVar

from bidex_algos.checks import positive
from bidex_algos.offpolicy.config import OffPolicyConfig
from bidex_meta.errors import BidexError


@dataclass(frozen=True)
class MTSACConfig(OffPolicyConfig):
    """Everything that can be set about MT-SAC; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "mtsac"

    init_std: float = 0.5
    """Standard deviation of the actions at the start, before the squashing."""
    std_range: tuple[float, float] = (0.02, 2.0)
    """Its bounds."""
    alpha_learning_rate: float = 3e-3
    """Adam's step size for the logarithms of the temperatures."""
    init_alpha: float = 0.001
    """Temperature of every task at the start."""
    target_entropy_per_action: float = -1.0
    """Entropy of the squashed policy that each temperature aims at, for each action; uniform actions have 0.69."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        super().__post_init__()
        positive(self, "init_alpha")
        low, high = self.std_range
        if not 0.0 < low < self.init_std < high:
            raise BidexError(
                f"mtsac: std_range must be two positive numbers with init_std between them, got {low} {high} and "
                f"{self.init_std}."
            )


# What the published settings have in common: log standard deviations from -20 to 2, one step size for all, nothing
# normalised.
_PLAIN = MTSACConfig(
    value_heads=False, critic_layer_norm=False, init_std=1.0, std_range=(2e-9, 7.4), learning_rate=3e-4,
    critic_learning_rate=3e-4, alpha_learning_rate=3e-4, max_grad_norm=1.0, normalise_observations=False,
    per_task_rewards=False,
)  # fmt: skip

PRESETS: dict[str, MTSACConfig] = {
    # Table 43 of the Bi-DexHands appendix (SAC, "other tasks"; it has none for MT-SAC): layers, step size, discount,
    # Polyak 0.99, gradient norm, entropy coefficient 0.2 (here where each temperature starts), reward scale 1, 5000
    # steps of replay, 1 epoch of 4 mini-batches of 32 (here after every vector step, and of each task). From Table 49
    # (SAC on Humanoid) only what Table 43 leaves out: 32 steps, here between two reports. Both are silent on
    # non-linearity, bounds of the standard deviation, target entropy and warm-up, and learn no temperature.
    "paper": replace(
        _PLAIN, hidden=(1024, 1024, 1024), replay_steps=5000, warmup_steps=32, steps_per_iteration=32,
        updates_per_step=4, batch_per_task=32, gamma=0.96, tau=0.01, init_alpha=0.2,
    ),
    "laptop": MTSACConfig(),
    # MT-SAC as Meta-World's baselines run it, with one row of each task: 128 transitions of each task in an update, one
    # update a vector step, 100,000 transitions of each task.
    "metaworld": replace(
        _PLAIN, hidden=(400, 400, 400), replay_steps=100_000, warmup_steps=4000, steps_per_iteration=500,
        updates_per_step=1, batch_per_task=128, gamma=0.99, tau=0.005, adam_eps=1e-5, init_alpha=1.0,
    ),
}  # fmt: skip

"""What can be set about DDPG, and its presets; imports no torch, so that a command line can show it at once."""

from dataclasses import dataclass
from typing import Any, ClassVar

from bidex_algos.checks import at_least
from bidex_algos.offpolicy.config import OffPolicyConfig
from bidex_meta.errors import BidexError


@dataclass(frozen=True)
class DDPGConfig(OffPolicyConfig):
    """Everything that can be set about DDPG; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "ddpg"

    exploration_std: tuple[float, float] = (0.05, 0.5)
    """Standard deviation of the noise on actions: of the first row of each task, of its last; evenly between."""
    squash_price: float = 1.0
    """Price, in the actor's loss, on the mean square of what tanh makes the actions of; 0: none."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        super().__post_init__()
        at_least(self, 0, "squash_price")
        low, high = self.exploration_std
        if not 0.0 <= low <= high:
            raise BidexError(
                f"{self.algo}: exploration_std must be two numbers, 0 <= first <= second, got {low} {high}."
            )


def of_paper() -> dict[str, Any]:
    """What DDPG and TD3 share of the preset ``paper``, by field.

    The Bi-DexHands appendix describes both (B.1.3, B.1.4) and has no table for either. Table 43 (SAC, "other tasks")
    has layers, step size, discount, Polyak 0.99, gradient norm, 5000 steps of replay and 1 epoch of 4 mini-batches of
    32 (here of each task); Table 49 32 steps between two reports. The noise of 0.1 is Fujimoto et al.'s (2018, section
    6.1).
    """
    return {
        "hidden": (1024, 1024, 1024),
        "value_heads": False,
        "critic_layer_norm": False,
        "replay_steps": 5000,
        "warmup_steps": 32,
        "steps_per_iteration": 32,
        "updates_per_step": 4,
        "batch_per_task": 32,
        "gamma": 0.96,
        "tau": 0.01,
        "learning_rate": 3e-4,
        "critic_learning_rate": 3e-4,
        "max_grad_norm": 1.0,
        "normalise_observations": False,
        "per_task_rewards": False,
        "exploration_std": (0.1, 0.1),
        "squash_price": 0.0,
    }


PRESETS: dict[str, DDPGConfig] = {"paper": DDPGConfig(**of_paper()), "laptop": DDPGConfig()}

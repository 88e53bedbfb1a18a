"""What can be set about HAPPO, and its presets; imports no torch."""

from dataclasses import dataclass
from typing import ClassVar

from bidex_algos.multiagent.config import PAPER_PPO, InTurnConfig, MultiAgentPPOConfig


@dataclass(frozen=True)
class HAPPOConfig(InTurnConfig, MultiAgentPPOConfig):
    """Everything that can be set about HAPPO; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "happo"

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        super().__post_init__()
        self._check_turns()


PRESETS: dict[str, HAPPOConfig] = {
    # Table 44; its replay, Polyak factor and reward scale are of no use to an on-policy learner.
    "paper": HAPPOConfig(
        **PAPER_PPO, learning_rate=1e-4, critic_learning_rate=1e-4, max_grad_norm=1.0, init_std=1.0,
        max_factor=0.0,
    ),
    "laptop": HAPPOConfig(),
}  # fmt: skip

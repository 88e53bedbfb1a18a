"""What can be set about HAPPO, and its presets; imports no torch."""

from dataclasses import dataclass
from typing import ClassVar

from bidex_algos.multiagent.config import PAPER_PPO, MultiAgentPPOConfig


@dataclass(frozen=True)
class HAPPOConfig(MultiAgentPPOConfig):
    """Everything that can be set about HAPPO; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "happo"


PRESETS: dict[str, HAPPOConfig] = {
    # Table 44; its replay, Polyak factor and reward scale are of no use to an on-policy learner.
    "paper": HAPPOConfig(
        **PAPER_PPO, learning_rate=1e-4, critic_learning_rate=1e-4, max_grad_norm=1.0, init_std=1.0,
    ),
    "laptop": HAPPOConfig(),
}  # fmt: skip

"""What can be set about MAPPO, and its presets; imports no torch."""

from dataclasses import dataclass
from typing import ClassVar

from bidex_algos.multiagent.config import PAPER_PPO, MultiAgentPPOConfig


@dataclass(frozen=True)
class MAPPOConfig(MultiAgentPPOConfig):
    """Everything that can be set about MAPPO; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "mappo"

    share_parameters: bool = False
    """Give agents whose observations and actions are of one form a network together, which is told who acts."""


PRESETS: dict[str, MAPPOConfig] = {
    # Table 45. Its deviation is 0.5 sigmoid(s), s = 1 at first (std y and x coef); B.2.4 has one policy for all agents.
    "paper": MAPPOConfig(
        **PAPER_PPO, learning_rate=5e-4, critic_learning_rate=5e-4, max_grad_norm=10.0, adam_eps=5e-4,
        init_std=0.3655, std_range=(0.01, 0.5), share_parameters=True,
    ),
    "laptop": MAPPOConfig(),
}  # fmt: skip

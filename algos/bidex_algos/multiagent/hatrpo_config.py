"""What can be set about HATRPO, and its presets; imports no torch."""

from dataclasses import dataclass
from typing import ClassVar

from bidex_algos.multiagent.config import PAPER, InTurnConfig, MultiAgentConfig
from bidex_algos.onpolicy.mttrpo_config import MTTRPOConfig


@dataclass(frozen=True)
class HATRPOConfig(InTurnConfig, MTTRPOConfig, MultiAgentConfig):
    """Everything that can be set about HATRPO; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "hatrpo"

    max_kl: float = 0.05
    """Mean KL of the new policy from the sampling one, of all agents together, that an update may not exceed; each
    agent's has an even share."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        super().__post_init__()
        self._check_turns()


PRESETS: dict[str, HATRPOConfig] = {
    # There is no table for HATRPO: HAPPO's (44), with the trust region of our TRPO's preset of this name.
    "paper": HATRPOConfig(
        **PAPER, max_kl=0.01, damping=0.1, cg_iterations=10, fisher_stride=1, backtracks=10, backtrack_factor=0.5,
        accept_ratio=0.1, critic_learning_rate=1e-4, critic_epochs=5, num_minibatches=1, max_grad_norm=1.0,
        init_std=1.0, max_factor=0.0,
    ),
    "laptop": HATRPOConfig(),
}  # fmt: skip

"""What can be set about MT-TRPO, and its presets; imports no torch, so that a command line can show it at once."""

from dataclasses import dataclass
from typing import ClassVar

from bidex_algos.checks import at_least, between, positive
from bidex_algos.choices import Autocast
from bidex_algos.onpolicy.config import TABLE_47, OnPolicyConfig


@dataclass(frozen=True)
class MTTRPOConfig(OnPolicyConfig):
    """Everything that can be set about MT-TRPO; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "mttrpo"

    max_kl: float = 0.1
    """Mean KL of the new policy from the sampling one that an update may not exceed."""
    damping: float = 0.1
    """Added to the diagonal of the Fisher matrix, so that the step stays short along directions that the samples tell
    nothing about."""
    cg_iterations: int = 10
    """Conjugate-gradient iterations."""
    fisher_stride: int = 4
    """Every so many-th sample goes into the Fisher matrix; it needs fewer than the gradient, and is multiplied once an
    iteration."""
    backtracks: int = 10
    """Points that the line search tries."""
    backtrack_factor: float = 0.8
    """By which the line search shortens the step."""
    accept_ratio: float = 0.1
    """Share of the improvement promised by the gradient that must come true where the line search stops; more keeps to
    steps along which the surrogate is almost straight."""
    critic_learning_rate: float = 1e-3
    """Adam's step size of the critic."""
    critic_epochs: int = 4
    """The critic's passes over the rollout per update."""
    num_minibatches: int = 4
    """The critic's mini-batches per epoch."""
    max_grad_norm: float = 1.0
    """Gradients of the critic longer than this are shortened to it."""
    autocast: Autocast = "off"
    """Hidden layers in bfloat16: too coarse for the Fisher matrix, so off by default."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        super().__post_init__()
        at_least(self, 1, "cg_iterations", "fisher_stride", "backtracks", "critic_epochs", "num_minibatches")
        positive(self, "max_kl", "max_grad_norm")
        at_least(self, 0, "damping")
        between(self, 0.0, 1.0, "backtrack_factor", "accept_ratio")


PRESETS: dict[str, MTTRPOConfig] = {
    # The Bi-DexHands appendix has no table for TRPO. Networks, rollouts and returns are those of the nearest one, Table
    # 47 (MT-PPO); trust region and line search are the defaults of Bi-DexHands' MTTRPO class.
    "paper": MTTRPOConfig(
        **TABLE_47, max_kl=0.01, damping=0.1, cg_iterations=10, fisher_stride=1, backtracks=10, backtrack_factor=0.5,
        accept_ratio=0.1, critic_learning_rate=3e-4, critic_epochs=5,
    ),
    "laptop": MTTRPOConfig(),
}  # fmt: skip

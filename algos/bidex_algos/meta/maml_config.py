"""What can be set about MAML, and its presets; imports no torch, so that a command line can show it at once."""

from dataclasses import dataclass
from typing import ClassVar, Literal

from bidex_algos.checks import at_least, between, positive
from bidex_algos.meta.config import TABLE_48, TUNED, UNSEEN, OuterConfig


@dataclass(frozen=True)
class MAMLConfig(OuterConfig):
    """Everything that can be set about MAML; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "maml"

    outer: Literal["trpo", "adam"] = "trpo"
    """How the meta-parameters move: a trust-region step, as in the paper, or one step of Adam."""
    outer_learning_rate: float = 1e-3
    """Adam's step size for the meta-parameters."""
    max_grad_norm: float = 1.0
    """Before a step of Adam, meta-gradients longer than this are shortened to it."""
    max_kl: float = 0.01
    """Mean KL of the adapted policies from those that sampled that a trust-region step may not exceed."""
    damping: float = 1e-2
    """Added to the diagonal of the Fisher matrix."""
    cg_iterations: int = 10
    """Conjugate-gradient iterations."""
    backtracks: int = 15
    """Points that the line search tries."""
    backtrack_factor: float = 0.8
    """By which the line search shortens the step."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        super().__post_init__()
        at_least(self, 1, "cg_iterations", "backtracks")
        at_least(self, 0, "damping")
        positive(self, "outer_learning_rate", "max_grad_norm", "max_kl")
        between(self, 0.0, 1.0, "backtrack_factor")


PRESETS: dict[str, MAMLConfig] = {
    # The Bi-DexHands appendix has no table for MAML: all but the trust region, MAML's own, is as in ProMP's.
    "paper": MAMLConfig(**TABLE_48, max_kl=0.01, damping=1e-5),
    "tuned": MAMLConfig(**TUNED),
    "unseen": MAMLConfig(**UNSEEN),
    "laptop": MAMLConfig(),
}

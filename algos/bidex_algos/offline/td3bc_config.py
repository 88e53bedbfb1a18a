"""What can be set about TD3+BC, and its presets; imports no torch, so that a command line can show it at once."""

from dataclasses import dataclass
from typing import ClassVar

from bidex_algos.checks import at_least
from bidex_algos.offline.config import PAPER, CriticConfig


@dataclass(frozen=True)
class TD3BCConfig(CriticConfig):
    """Everything that can be set about TD3+BC; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "td3bc"

    alpha: float = 2.5
    """Weight of the value, divided by the mean absolute value of the batch, beside the distance to the data; 0: BC."""
    target_std: float = 0.2
    """Standard deviation of the noise on the target actor's actions."""
    target_bound: float = 0.5
    """That noise is cut to plus and minus this."""
    policy_delay: int = 2
    """Updates of the critics for each of the actor and the targets."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        super().__post_init__()
        at_least(self, 0, "alpha", "target_std", "target_bound")
        at_least(self, 1, "policy_delay")


# "paper": alpha is Table 46's, whose other numbers are the defaults; noise, its bound and the delay, which it leaves
# out, and alpha of "laptop" are those of Fujimoto and Gu (2021, table 3), who also normalise observations.
PRESETS: dict[str, TD3BCConfig] = {"paper": TD3BCConfig(alpha=0.2, **PAPER), "laptop": TD3BCConfig()}

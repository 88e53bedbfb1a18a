"""What can be set about IQL, and its presets; imports no torch, so that a command line can show it at once."""

from dataclasses import dataclass
from typing import ClassVar

from bidex_algos.checks import at_least, positive, rising
from bidex_algos.offline.config import PAPER, CriticConfig
from bidex_meta.errors import BidexError


@dataclass(frozen=True)
class IQLConfig(CriticConfig):
    """Everything that can be set about IQL; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "iql"

    expectile: float = 0.7
    """Which expectile of the values of the data's actions a state is worth: 0.5 their mean, towards 1 the best one."""
    beta: float = 3.0
    """Weight of an action in the actor's update: exp(beta * advantage); 0: BC."""
    max_weight: float = 100.0
    """That weight is cut to this."""
    init_std: float = 1.0
    """Standard deviation of the actor at the start."""
    std_range: tuple[float, float] = (0.0067, 7.4)
    """Its bounds, exp(-5) and exp(2)."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        super().__post_init__()
        at_least(self, 0, "beta")
        positive(self, "max_weight", "init_std")
        rising(self, "std_range")
        if not 0.0 < self.expectile < 1.0:
            raise BidexError(f"{self.algo}: expectile must lie in (0, 1), got {self.expectile}.")


# Table 46's numbers are the defaults. The bound of the weight is that of Kostrikov et al. (2022, their code).
PRESETS: dict[str, IQLConfig] = {"paper": IQLConfig(normalise_observations=False, **PAPER), "laptop": IQLConfig()}

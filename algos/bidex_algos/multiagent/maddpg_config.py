"""What can be set about MADDPG, and its presets; imports no torch."""

from dataclasses import dataclass
from typing import ClassVar

from bidex_algos.multiagent.config import Partition, keep_partition
from bidex_algos.offpolicy.ddpg_config import DDPGConfig, of_paper


@dataclass(frozen=True)
class MADDPGConfig(DDPGConfig):
    """Everything that can be set about MADDPG; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "maddpg"

    agents: Partition = "hands"
    """Who acts: hands (two agents), fingers (twelve: five fingers and the palm of each hand), single, a TOML file with
    a table [agents], or name=unit+unit;name=unit (docs/learners/multiagent.md)."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range, or ``agents`` is no partition.
        """
        super().__post_init__()
        keep_partition(self)


# There is no table for MADDPG (B.2.5 describes it): DDPG's preset of this name.
PRESETS: dict[str, MADDPGConfig] = {"paper": MADDPGConfig(**of_paper()), "laptop": MADDPGConfig()}

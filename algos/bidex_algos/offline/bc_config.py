"""What can be set about BC, and its presets; imports no torch, so that a command line can show it at once."""

from dataclasses import dataclass
from typing import ClassVar

from bidex_algos.offline.config import OfflineConfig


@dataclass(frozen=True)
class BCConfig(OfflineConfig):
    """Everything that can be set about BC; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "bc"


# Bi-DexHands compares with BC and has no table for it: layers, step size and batch are TD3+BC's of Table 46.
PRESETS: dict[str, BCConfig] = {"paper": BCConfig(), "laptop": BCConfig()}

"""What can be set about IPPO, and its presets; imports no torch."""

from dataclasses import dataclass
from typing import ClassVar

from bidex_algos.multiagent import mappo_config
from bidex_algos.multiagent.mappo_config import MAPPOConfig
from bidex_meta.errors import BidexError


@dataclass(frozen=True)
class IPPOConfig(MAPPOConfig):
    """Everything that can be set about IPPO; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "ippo"

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        super().__post_init__()
        if self.popart and self.share_parameters:
            raise BidexError("ippo: popart needs a critic for each agent; leave popart or share_parameters off.")


_MAPPO = mappo_config.PRESETS["paper"]

PRESETS: dict[str, IPPOConfig] = {
    # There is no table for IPPO: MAPPO's. B.2.1 has a policy and a critic for each agent.
    "paper": IPPOConfig(**{**vars(_MAPPO), "share_parameters": False}),
    "laptop": IPPOConfig(),
}

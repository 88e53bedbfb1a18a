"""What can be set about IPPO, and its presets; imports no torch."""

from dataclasses import dataclass, replace
from typing import ClassVar

from bidex_algos.multiagent import mappo_config
from bidex_algos.multiagent.mappo_config import MAPPOConfig


@dataclass(frozen=True)
class IPPOConfig(MAPPOConfig):
    """Everything that can be set about IPPO; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "ippo"


_MAPPO = mappo_config.PRESETS["paper"]

PRESETS: dict[str, IPPOConfig] = {
    # There is no table for IPPO: MAPPO's. B.2.1 has a policy and a critic for each agent.
    "paper": replace(IPPOConfig(**vars(_MAPPO)), share_parameters=False),
    "laptop": IPPOConfig(),
}

"""IPPO: PPO of several agents, each with a critic that sees no more than it does (de Witt et al. 2020; appendix B.2.1).

MAPPO but for the critics: each agent has its own values, returns and advantages, normalised per task.
"""

from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor, nn

from bidex_algos.multiagent import mappo as mappo_config
from bidex_algos.multiagent.base import LIFT
from bidex_algos.multiagent.mappo import MAPPO, MAPPOConfig
from bidex_algos.multiagent.team import TeamCritic
from bidex_algos.nets.networks import autocast
from bidex_meta.errors import BidexError
from bidex_meta.world.agent_views import agent_views
from bidex_meta.world.contract import VectorWorld


@dataclass(frozen=True)
class IPPOConfig(MAPPOConfig):
    """Everything that can be set about IPPO; the defaults are the preset ``laptop``."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.popart and self.share_parameters:
            raise BidexError("ippo: popart needs a critic for each agent; leave popart or share_parameters off.")


_MAPPO = mappo_config.PRESETS["paper"]

PRESETS: dict[str, IPPOConfig] = {
    # There is no table for IPPO: MAPPO's. B.2.1 has a policy and a critic for each agent.
    "paper": IPPOConfig(**{**vars(_MAPPO), "share_parameters": False}),
    "laptop": IPPOConfig(),
}
TASK_PRESETS = {"LiftUnderarm": {"paper": replace(PRESETS["paper"], **LIFT)}}


class IPPO(MAPPO):
    """IPPO, independent PPO (de Witt et al. 2020, arXiv 2011.09533)."""

    name = "ippo"
    config_type, presets, task_presets = IPPOConfig, PRESETS, TASK_PRESETS
    config: IPPOConfig
    critic: TeamCritic  # type: ignore[assignment]

    def __init__(self, world: VectorWorld, config: IPPOConfig, seed: int):
        actions = int(world.single_action_space.shape[0])
        self.num_critics = len(agent_views(world.observation_groups, actions, config.agents))
        super().__init__(world, config, seed)

    def _make_critic(self, heads: int) -> nn.Module:
        return TeamCritic(self.views, self.config, heads, self.initial, self.config.share_parameters)

    def _critics(self) -> list[Any]:
        return list(self.critic.nets)

    def _critic(self, obs: Tensor, task_id: Tensor) -> Tensor:
        """Values (B, agents); of one agent alone (B,)."""
        with autocast(self.device, self.low_precision):
            out = self.critic(obs)
        if self.config.value_heads:
            out = out.gather(1, task_id[:, None, None].expand(-1, 1, out.shape[2]))
        return out.squeeze(1) if self.num_critics > 1 else out.view(-1)

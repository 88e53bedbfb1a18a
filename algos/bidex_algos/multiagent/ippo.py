"""IPPO: PPO of several agents, each with its own critic (de Witt et al. 2020; Bi-DexHands' appendix B.2.1).

IPPO differs from MAPPO only in the critics: each agent has a critic on its own observations. Each agent therefore has
its own values, returns and advantages, normalised per task.
"""

from dataclasses import dataclass, replace

from torch import Tensor, nn

from bidex_algos.multiagent.base import LIFT
from bidex_algos.multiagent.mappo import MAPPO, TABLE_45, MAPPOConfig
from bidex_algos.multiagent.team import TeamCritic
from bidex_algos.nets.networks import MLP, autocast
from bidex_algos.nets.policy import of_head
from bidex_meta.errors import BidexError
from bidex_meta.world.agent_views import agent_views
from bidex_meta.world.contract import VectorWorld


@dataclass(frozen=True)
class IPPOConfig(MAPPOConfig):
    """All options of IPPO; the defaults are the preset ``laptop``."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.popart and self.share_parameters:
            raise BidexError("ippo: popart needs a critic for each agent; leave popart or share_parameters off.")


PRESETS: dict[str, IPPOConfig] = {
    # There is no table for IPPO, so the values are MAPPO's. B.2.1 describes a policy and a critic for each agent.
    "paper": IPPOConfig(**TABLE_45),
    "laptop": IPPOConfig(),
}
TASK_PRESETS = {"LiftUnderarm": {"paper": replace(PRESETS["paper"], **LIFT)}}


class IPPO(MAPPO):
    """IPPO, independent PPO (de Witt et al. 2020, arXiv 2011.09533)."""

    name = "ippo"
    config_type = IPPOConfig
    presets = PRESETS
    task_presets = TASK_PRESETS
    config: IPPOConfig
    critic: TeamCritic  # type: ignore[assignment]

    def __init__(self, world: VectorWorld, config: IPPOConfig, seed: int):
        actions = int(world.single_action_space.shape[0])
        self.num_critics = len(agent_views(world.observation_groups, actions, config.agents))
        super().__init__(world, config, seed)

    def _make_critic(self, heads: int) -> nn.Module:
        return TeamCritic(self.views, self.config, heads, self.initial, self.config.share_parameters)

    def _critics(self) -> list[MLP]:
        return [*self.critic.nets]  # type: ignore[list-item]

    def _critic(self, obs: Tensor, task_id: Tensor) -> Tensor:
        """Return the critics' values (B, agents) for observations; with a single agent the shape is (B,)."""
        with autocast(self.device, self.low_precision):
            out = self.critic(obs)
        if self.config.value_heads:
            out = of_head(out, task_id)
        else:
            out = out.squeeze(1)
        return out if self.num_critics > 1 else out.view(-1)

"""MADDPG: DDPG of several agents with a critic that sees everything (Lowe et al. 2017; Bi-DexHands' appendix B.2.5).

Each agent i maximises Q(x, a_1, ..., mu_i(o_i), ..., a_n) with the other agents' actions from the replay. Everything
else is as in DDPG. The original has a critic for each agent because rewards may differ. Here the agents share rewards,
so one critic is enough.
"""

from dataclasses import dataclass
from itertools import chain

import torch
from torch import Tensor

from bidex_algos.multiagent.base import Partition, keep_partition
from bidex_algos.multiagent.team import Team
from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.policy import DeterministicPolicy
from bidex_algos.nets.shape import Shape
from bidex_algos.offpolicy.ddpg import DDPG, OF_PAPER, DDPGConfig
from bidex_algos.replay import Transitions
from bidex_meta.world.agent_views import AgentView, agent_views
from bidex_meta.world.contract import VectorWorld


@dataclass(frozen=True)
class MADDPGConfig(DDPGConfig):
    """All options of MADDPG; the defaults are the preset ``laptop``."""

    agents: Partition = "hands"
    """Division of the hands into agents: hands (two agents), fingers (twelve: five fingers and the palm of each hand),
    single (one), a TOML file with a table [agents], or name=unit+unit;name=unit (docs/learners/multiagent.md)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        keep_partition(self)


# There is no table for MADDPG (B.2.5 describes it), so the values are DDPG's preset of this name.
PRESETS: dict[str, MADDPGConfig] = {"paper": MADDPGConfig(**OF_PAPER), "laptop": MADDPGConfig()}


class DeterministicTeam(Team):
    """The networks of all agents as a single deterministic actor, which replaces a ``DeterministicActor``."""

    def __init__(
        self, views: tuple[AgentView, ...], config: MADDPGConfig, groups: Inputs, generator: torch.Generator, heads: int
    ):
        super().__init__(views, config, [heads * len(view.actions) for view in views], 0.01, generator)
        self.heads = heads
        self.one_hot = groups.columns(*["task_id"] * (heads > 1))
        self._order: Tensor
        order = torch.tensor(list(chain.from_iterable(view.actions for view in views))).argsort()
        self.register_buffer("_order", order, persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Return joint actions for normalised observations (B, d): float32 (B, a) in [-1, 1]."""
        return torch.tanh(self.raw(x))

    def raw(self, x: Tensor) -> Tensor:
        """Return the joint actions before squashing: float32 (B, a)."""
        outputs = self.outputs(x)
        if self.heads > 1:
            head = self.one_hot(x).argmax(1)
            rows = torch.arange(len(x), device=x.device)
            outputs = [out.unflatten(1, (self.heads, -1))[rows, head] for out in outputs]
        return torch.cat(outputs, dim=-1).index_select(-1, self._order)


class MADDPG(DDPG):
    """MADDPG, multi-agent DDPG (Lowe et al. 2017, arXiv 1706.02275)."""

    name = "maddpg"
    config_type = MADDPGConfig
    presets = PRESETS
    config: MADDPGConfig

    def __init__(self, world: VectorWorld, config: MADDPGConfig, seed: int):
        actions = int(world.single_action_space.shape[0])
        self.views = agent_views(world.observation_groups, actions, config.agents)
        super().__init__(world, config, seed)
        owner = [next(i for i, view in enumerate(self.views) if action in view.actions) for action in range(actions)]
        self.owner = torch.tensor(owner, device=self.device)

    def _policy_step(self, obs: Tensor, draw: Transitions, weights: Tensor, counts: Tensor) -> None:
        raw = self.policy.raw(obs)
        share = weights / counts.sum().clamp_min(1.0)
        actions = torch.tanh(raw)
        losses = []
        for agent, view in enumerate(self.views):
            mine = torch.where(self.owner == agent, actions, draw.actions)
            value = self._values(self.critic, obs, mine)[0]
            # The penalty is averaged over all actions, not the agent's own, so that it does not depend on the
            # partition.
            price = self.config.squash_price * raw[:, list(view.actions)].square().sum(1) / raw.shape[1]
            losses.append((share * (price - value)).sum())
        loss = torch.stack(losses).sum()
        reported = loss.detach()[None] / len(self.views)
        self.actor_loss = self._descend(loss, reported, "actor", actor=list(self.policy.actor.parameters()))[0]

    @classmethod
    def _make_policy(
        cls, config: MADDPGConfig, shape: Shape, init: torch.Generator, device: torch.device
    ) -> DeterministicPolicy:
        views = agent_views(shape.groups, shape.actions, config.agents)
        inputs = Inputs(shape.groups)
        if config.policy_heads:
            heads = shape.num_id_columns
        else:
            heads = 1
        actor = DeterministicTeam(views, config, inputs, init, heads)
        return DeterministicPolicy.made_of(actor, config, inputs, shape, device).to(device)

"""One network per agent on its own observations; agents with inputs and outputs of equal size share a forward pass."""

import math
from collections.abc import Sequence
from itertools import chain
from typing import cast

import torch
from torch import Tensor, nn

from bidex_algos.nets.architecture import NetworkConfig
from bidex_algos.nets.inputs import Columns, Inputs, with_task_embedding
from bidex_algos.nets.networks import MLP, head_of, row_of, stacked_forward
from bidex_algos.nets.point_net import with_point_net
from bidex_algos.onpolicy.base import OnPolicyConfig
from bidex_meta.world.agent_views import AgentView


class Team(nn.Module):
    """One :class:`MLP` per agent; agent i has network ``nets[net_of[i]]``.

    Agents with equal sizes of observation groups and actions form a family (``families``). With ``share`` a family has
    one network, whose input includes a one-hot of the agent.
    """

    def __init__(
        self, views: Sequence[AgentView], config: NetworkConfig | OnPolicyConfig, outputs: Sequence[int],
        output_gain: float, generator: torch.Generator, share: bool = False
    ):  # fmt: skip
        super().__init__()
        forms = [(tuple(group.size for group in view.own_groups()), len(view.actions)) for view in views]
        families: dict[object, list[int]] = {}
        for i, form in enumerate(forms):
            families.setdefault(form, []).append(i)
        self.families = list(families.values())
        self.columns = nn.ModuleList()
        for view in views:
            self.columns.append(Columns(chain.from_iterable(group.where for group in view.groups)))
        self.share = share
        made = list[MLP]()
        self.net_of = [0] * len(views)
        for i, view in enumerate(views):
            family = next(family for family in self.families if i in family)
            inputs = Inputs(view.own_groups())
            if share and family[0] != i:
                self.net_of[i] = self.net_of[family[0]]
                continue
            if share and len(family) > 1:
                inputs = inputs.extended("agent", len(family))
            inputs = with_task_embedding(with_point_net(inputs, config), vars(config).get("task_embedding", 0))
            self.net_of[i] = len(made)
            made.append(MLP(inputs, config.hidden, outputs[i], output_gain, generator, config.activation))
        self.nets = nn.ModuleList(made)

    def output(self, agent: int, x: Tensor) -> Tensor:
        """Return one agent's network output for normalised observations (B, d): float32 (B, outputs[agent])."""
        return self.nets[self.net_of[agent]](self.seen(agent, x))

    def outputs(self, x: Tensor) -> list[Tensor]:
        """Return every agent's network output for normalised observations (B, d)."""
        found: dict[int, Tensor] = {}
        for family in self.families:
            if len(family) == 1:
                found[family[0]] = self.output(family[0], x)
                continue
            together = torch.stack([self.seen(i, x) for i in family])
            found.update(zip(family, self._family(family, together), strict=True))
        return [found[i] for i in range(len(self.net_of))]

    def _family(self, family: list[int], x: Tensor) -> Tensor:
        nets = [cast(MLP, self.nets[self.net_of[i]]) for i in family]
        if self.share:
            return nets[0](x.flatten(0, 1)).unflatten(0, x.shape[:2])
        if not nets[0].encoder.identity:  # each agent has its own encoder
            return torch.stack([net(own) for net, own in zip(nets, x, strict=True)])
        parameters = [dict(net.named_parameters()) for net in nets]
        stacked = {name: torch.stack([each[name] for each in parameters]) for name in parameters[0]}
        return stacked_forward(nets[0], stacked, "", x)

    def seen(self, agent: int, x: Tensor) -> Tensor:
        """Select one agent's network input from normalised observations (..., d)."""
        seen = self.columns[agent](x)
        family = next(family for family in self.families if agent in family)
        if not self.share or len(family) == 1:
            return seen
        who = seen.new_zeros(len(family))
        who[family.index(agent)] = 1.0
        return torch.cat([seen, who.expand(*seen.shape[:-1], -1)], dim=-1)


class TeamActor(Team):
    """Diagonal Gaussians of all agents, which together form one Gaussian of the world's action.

    The class replaces a ``GaussianActor``. ``log_stds`` holds the log standard deviations of each network. They have
    the shape (a_i,) with one head and (heads, a_i) with several; with several, the task in the observation selects the
    row.
    """

    def __init__(
        self, views: Sequence[AgentView], config: OnPolicyConfig, groups: Inputs, generator: torch.Generator,
        heads: int = 1, share: bool = False
    ):  # fmt: skip
        super().__init__(views, config, [heads * len(view.actions) for view in views], 0.01, generator, share)
        self.heads = heads
        self.one_hot = groups.columns(*["task_id"] * (heads > 1))
        order = torch.tensor(list(chain.from_iterable(view.actions for view in views)))
        self._order: Tensor
        self._taken: Tensor
        self.register_buffer("_order", order.argsort(), persistent=False)
        self.register_buffer("_taken", order, persistent=False)
        self._sizes = [len(view.actions) for view in views]
        sizes = [len(views[self.net_of.index(k)].actions) for k in range(len(self.nets))]
        self.log_stds = nn.ParameterList()
        for size in sizes:
            shape = (size,) if heads == 1 else (heads, size)
            self.log_stds.append(nn.Parameter(torch.full(shape, math.log(config.init_std))))

    @property
    def own(self) -> list[Tensor]:
        """Return, for each agent, the indices of its actions in the world's action."""
        return list(self._taken.split(self._sizes))

    @property
    def log_std(self) -> Tensor:
        """Return log standard deviations in the order of the world's actions, (a,) or (heads, a)."""
        return torch.cat([self.log_stds[k] for k in self.net_of], dim=-1).index_select(-1, self._order)

    def forward(self, x: Tensor) -> Tensor:
        """Return the mean joint action for normalised observations (B, d), float32 (B, a), not clamped."""
        return torch.cat(self.means(x), dim=-1).index_select(-1, self._order)

    def means(self, x: Tensor) -> list[Tensor]:
        """Return the mean action (B, a_i) of each agent."""
        task = self.one_hot(x)
        return [head_of(task, out, self.heads) for out in self.outputs(x)]

    def distribution_of(self, agent: int, seen: Tensor, task: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean (B, a_i) and log standard deviation, (a_i,) or (B, a_i), of one agent's actions.

        ``seen`` is the input of the agent's network. ``task`` is the one-hot of each sample's task.
        """
        return head_of(task, self.nets[self.net_of[agent]](seen), self.heads), self.own_log_std(agent, task)

    def own_log_std(self, agent: int, task: Tensor) -> Tensor:
        """Return one agent's log standard deviation, the second result of :meth:`distribution_of`."""
        return row_of(task, self.log_stds[self.net_of[agent]])

    def parts(self, joint: Tensor) -> tuple[Tensor, ...]:
        """Split a tensor over the world's actions (..., a) into each agent's entries (..., a_i)."""
        return joint.index_select(-1, self._taken).split(self._sizes, dim=-1)

    def log_std_of(self, x: Tensor, log_std: Tensor | None = None) -> Tensor:
        """Return the log standard deviations of all actions for observations (B, d).

        The shape is (a,) with one head. With several heads, the task in each observation selects a row of ``log_std``,
        and the shape is (B, a). If the argument ``log_std`` is None, the attribute of this name is used.
        """
        return row_of(self.one_hot(x), self.log_std if log_std is None else log_std)

    def parameters_of(self, net: int) -> list[nn.Parameter]:
        """Return the parameters of the network with index ``net``, and its log standard deviations."""
        return [*self.nets[net].parameters(), self.log_stds[net]]

    @torch.no_grad()
    def clamp_std(self, low: float, high: float) -> None:
        """Clamp all standard deviations to [``low``, ``high``]."""
        for log_std in self.log_stds:
            log_std.clamp_(math.log(low), math.log(high))


class TeamCritic(Team):
    """One critic per agent, which reads the agent's own observations and has ``heads`` outputs.

    The other arguments are those of :class:`Team`.
    """

    def __init__(
        self, views: Sequence[AgentView], config: NetworkConfig | OnPolicyConfig, heads: int,
        generator: torch.Generator, share: bool = False
    ):  # fmt: skip
        super().__init__(views, config, [heads] * len(views), 1.0, generator, share)

    def forward(self, x: Tensor) -> Tensor:
        """Return the state values of normalised observations (B, d): float32 (B, heads, agents)."""
        return torch.stack(self.outputs(x), dim=-1)

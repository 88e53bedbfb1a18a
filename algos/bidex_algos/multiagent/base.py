"""The base of on-policy learners of several agents: the agents' policy, a common critic, and the critic's loss.

The base class treats the agents as one policy with a joint action, which concatenates the agents' actions. An update
splits the joint action again into the agents' parts.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any

import torch
import tyro
from torch import Tensor, nn

from bidex_algos.multiagent.team import TeamActor
from bidex_algos.nets.architecture import Networks, Options
from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import MLP, autocast, gaussian_log_prob
from bidex_algos.nets.policy import GaussianPolicy
from bidex_algos.nets.shape import Shape
from bidex_algos.onpolicy.base import Batch, OnPolicy, OnPolicyConfig
from bidex_algos.onpolicy.ppo import AdaptiveAdam, OptionalRateConfig, mini_batches
from bidex_algos.rollout import check_samples
from bidex_meta.errors import BidexError
from bidex_meta.hands.units import partition_line
from bidex_meta.training.distributed import sum_gradients
from bidex_meta.training.learner import LearnerConfig, Parts
from bidex_meta.utils.validation import Count, Finite, NonNegative, Positive
from bidex_meta.world.agent_views import agent_views
from bidex_meta.world.contract import VectorWorld

Partition = Annotated[str, tyro.conf.arg(aliases=("--agents",))]
"""A partition of the hands' units, with a short alias on the command line."""


def keep_partition(config: Networks) -> None:
    """Check a config's division of the hands into agents, and replace the path of a file by the file's content.

    A checkpoint therefore does not depend on the file. BidexError is raised if the division is wrong, or if the
    architecture is not ``shared``.
    """
    if config.architecture != "shared":
        raise BidexError(f"{config.algo}: each agent has a plain network; architecture must be shared.")
    object.__setattr__(config, "agents", partition_line(vars(config)["agents"]))


@dataclass(frozen=True)
class MultiAgentConfig(OnPolicyConfig):
    """Options of agents and of the critic's loss."""

    agents: Partition = "hands"
    """Division of the hands into agents: hands (two agents), fingers (twelve: five fingers and the palm of each hand),
    single (one), a TOML file with a table [agents], or name=unit+unit;name=unit (docs/learners/multiagent.md)."""
    huber_delta: Positive = 10.0  # Error, in the critic's units, beyond which the critic's loss grows linearly.
    value_clip: NonNegative = 0.0  # Distance from the old value at which the loss clips a value; 0: no clipping.
    popart: bool = False  # Adjust the critic's output layer when the statistics of returns change, to preserve values.
    max_grad_norm: Positive = 1.0  # Gradients are clipped to this norm, separately for each agent and the critic.
    critic_learning_rate: Positive = 1e-3  # Adam's step size of the critic.
    num_minibatches: Count = 4  # Mini-batches per epoch; each holds shuffled samples of all environments.
    adam_eps: NonNegative = 1e-8  # Constant that Adam adds to its denominators.

    def __post_init__(self) -> None:
        super().__post_init__()
        keep_partition(self)
        if self.popart and not self.value_heads:
            raise BidexError(f"{self.algo}: popart moves the critic's output of each task; leave value_heads on.")


@dataclass(frozen=True)
class MultiAgentPPOConfig(OptionalRateConfig, MultiAgentConfig):
    """Options shared by IPPO, MAPPO and HAPPO; the defaults are the preset ``laptop``."""

    # These two fields narrow those of PPOConfig: the critic has its own step size, and agents share the KL.
    critic_learning_rate: Positive = 1e-3  # Adam's step size of the critic.
    value_loss_weight: Finite = 1.0  # Factor of the value loss; it only matters for max_grad_norm, as Adam cancels it.
    entropy_weight: Finite = 0.0  # Factor of the entropy bonus.
    desired_kl: Positive = 0.03
    """KL between the sampling and the current joint policy that the adaptive step sizes aim at. Each agent has an equal
    share of this KL."""


@dataclass(frozen=True)
class InTurnConfig(LearnerConfig):
    """Options shared by HAPPO and HATRPO; ``--help`` lists these options after those of the learner itself."""

    max_factor: NonNegative = 4.0
    """Largest factor by which the likelihood ratios of the previous agents may scale an agent's advantage; 0: no
    bound."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0 < self.max_factor < 1:
            raise BidexError(
                f"{self.algo}: max_factor: expected 0 or at least 1 (which means no change), got {self.max_factor}."
            )


PAPER: Options = {
    "hidden": (1024, 1024, 512), "popart": True, "rollout_steps": 8, "gamma": 0.96, "lam": 0.95,
    "normalise_observations": False, "huber_delta": 10.0, "value_clip": 0.2,
}  # fmt: skip
"""Values shared by Tables 44 (HAPPO) and 45 (MAPPO) of the Bi-DexHands appendix, in their columns for tasks other than
LiftUnderarm; B.2.1 and B.2.4 describe the clipped value."""

PAPER_PPO: Options = PAPER | {
    "num_minibatches": 1, "epochs": 5, "clip": 0.2, "adaptive_learning_rate": False, "entropy_weight": 0.0,
}  # fmt: skip
"""PAPER and, in addition, the values of both tables that only apply to PPO."""

LIFT: Options = {"rollout_steps": 20, "epochs": 10}  # values that differ in both tables' column for LiftUnderarm


@torch.no_grad()
def keep_values(critics: list[MLP], before: tuple[Tensor, Tensor], after: tuple[Tensor, Tensor]) -> None:
    """Adjust the critics' output layers so that std V + mean, the value in units of reward, does not change (PopArt).

    V is a critic's output, and mean and std are those of the returns (van Hasselt 2016, Hessel et al. 2019). Each
    critic has an output for each task. ``before`` is the old mean and standard deviation of the returns, and ``after``
    is the new mean and standard deviation; all are (critics * tasks,).
    """
    given = [x.view(len(critics), -1) for x in (*before, *after)]
    for critic, old_mean, old_std, mean, std in zip(critics, *given, strict=True):
        weight = critic.head.weight
        bias = critic.head.bias
        weight.copy_(weight * (old_std / std)[:, None])
        bias.copy_((old_std * bias + old_mean - mean) / std)


@dataclass
class AgentBatch:
    """B samples of one agent with a_i actions, extracted from the batch once; mini-batches only select rows of it."""

    seen: Tensor  # input of the agent's network (B, d_i)
    task: Tensor  # the tasks' one-hot (B, heads); (B, 0) if the agent has one head
    actions: Tensor  # the agent's part of the sampled actions (B, a_i)
    old_means: Tensor  # means of the sampling policy (B, a_i)
    old_log_std: Tensor  # log standard deviations of the sampling policy (B, a_i)
    old_log_probs: Tensor  # log-density of ``actions`` under the sampling policy (B,)
    gain: Tensor  # advantages in the agent's surrogate (B,)
    weights: Tensor  # weights of the samples, as in the batch (B,)

    def select(self, index: Tensor) -> "AgentBatch":
        """Return the samples of this batch at ``index``."""
        return AgentBatch(**{name: torch.index_select(value, 0, index) for name, value in vars(self).items()})


class TeamPolicy(GaussianPolicy):
    """All agents as one Gaussian policy of the world's action."""

    actor: TeamActor  # type: ignore[assignment]


class MultiAgent(OnPolicy):
    """Base of learners of several agents (``views``) that share a reward.

    Each agent has its own observations and policy. The KL divergence that an update may cause is divided equally among
    the agents.
    """

    config: MultiAgentConfig
    policy: TeamPolicy

    def __init__(self, world: VectorWorld, config: MultiAgentConfig, seed: int):
        self.views = agent_views(world.observation_groups, int(world.single_action_space.shape[0]), config.agents)
        self.kl_share = 1.0 / len(self.views)
        check_samples(self.name, config.rollout_steps, world.num_envs, config.num_minibatches)
        super().__init__(world, config, seed)
        rate = config.critic_learning_rate
        eps = config.adam_eps
        self.critic_adam = torch.optim.Adam(self.critic.parameters(), lr=rate, eps=eps, fused=True)

    @classmethod
    def _make_policy(
        cls, config: MultiAgentConfig, shape: Shape, init: torch.Generator, device: torch.device
    ) -> TeamPolicy:
        views = agent_views(shape.groups, shape.actions, config.agents)
        inputs = Inputs(shape.groups)
        if config.policy_heads:
            heads = shape.num_id_columns
        else:
            heads = 1
        share = vars(config).get("share_parameters", False)
        actor = TeamActor(views, config, inputs, init, heads, share)
        return TeamPolicy.made_of(actor, config, inputs, shape, device).to(device)

    def _critics(self) -> list[MLP]:
        """Return the networks of the critic: one for all agents, or one per agent."""
        return [self.critic]  # type: ignore[list-item]

    def _merge_returns(self, mean: Tensor, var: Tensor, count: Tensor) -> None:
        stats = self.return_stats
        known = stats.count > 0
        before = (stats.mean.clone(), stats.std())
        super()._merge_returns(mean, var, count)
        if self.config.popart:
            after = stats.mean, stats.std()
            # A task has no values before its first returns.
            old_mean, old_std = (torch.where(known, *pair) for pair in zip(before, after, strict=True))
            keep_values(self._critics(), (old_mean, old_std), after)

    def _old_values(self, batch: Batch) -> Tensor:
        if not self.config.value_clip:
            return batch.targets
        with torch.no_grad():
            return self._critic(batch.obs, batch.task_id)

    def _value_loss(self, b: Batch, old_values: Tensor, weights: Tensor) -> Tensor:
        """Return twice the Huber loss of the critic's values, a scalar.

        With ``value_clip``, the loss of a sample is the larger of two losses: the loss of its value, and the loss of
        the value after clipping to a distance of ``value_clip`` from the old value.
        """
        delta = self.config.huber_delta
        reach = self.config.value_clip
        values = self._critic(b.obs, b.task_id)

        def huber(values: Tensor) -> Tensor:
            return 2.0 * nn.functional.huber_loss(values, b.targets, reduction="none", delta=delta)

        loss = huber(values)
        if reach:
            loss = torch.maximum(loss, huber(old_values + (values - old_values).clamp(-reach, reach)))
        return (weights.view(-1, *[1] * (loss.dim() - 1)) * loss).sum()

    def _critic_step(self) -> None:
        for critic in self._critics():
            nn.utils.clip_grad_norm_(critic.parameters(), self.config.max_grad_norm)
        self.critic_adam.step()

    def _critic_epochs(self, batch: Batch, epochs: int, num_minibatches: int, weight: float = 1.0) -> Tensor:
        old_values = self._old_values(batch)
        losses = list[Tensor]()
        parameters = list(self.critic.parameters())
        for _, index, count in mini_batches(batch.weights, epochs, num_minibatches, self.generator):
            b = batch.select(index)
            loss = self._value_loss(b, old_values.index_select(0, index), b.weights / count)
            self.critic_adam.zero_grad()
            (weight * loss).backward()
            losses.append(sum_gradients(parameters, loss.detach()[None])[0])
            self._critic_step()
        return torch.stack(losses).mean()

    def _optimisers(self) -> Parts:
        return {"critic_adam": self.critic_adam}


class OwnAdams(MultiAgent):
    """Base of multi-agent learners with one optimiser per network.

    The step size of each optimiser adapts so that the KL divergence of an agent's policy stays near an equal share of
    the KL target.
    """

    config: MultiAgentPPOConfig

    def __init__(self, world: VectorWorld, config: MultiAgentPPOConfig, seed: int):
        super().__init__(world, config, seed)
        own = self.policy.actor.parameters_of
        desired_kl = config.followed_kl
        if desired_kl is not None:
            desired_kl = self.kl_share * desired_kl
        given = config.learning_rate, config.learning_rate_range, desired_kl, self.device, config.adam_eps
        self.adams = [AdaptiveAdam(own(k), *given) for k in range(len(self.policy.actor.nets))]

    def _optimisers(self) -> Parts:
        return super()._optimisers() | {"agents": [adam.parts() for adam in self.adams]}


class Sequential(MultiAgent):
    """Agents that are updated one after another, in a random order that is equal in all processes (Kuba et al. 2022).

    The advantage of an agent is multiplied by the likelihood ratios, new over old, of all agents updated before it. All
    agents learn from the same samples, so every agent can raise the ratios of the same few samples. With twelve agents
    the products of ratios grew to 20,000 within an update. ``max_factor`` bounds the products.
    """

    config: Any

    def __init__(self, world: VectorWorld, config: MultiAgentConfig, seed: int):
        super().__init__(world, config, seed)
        self.order = torch.Generator().manual_seed(seed)

    def _in_turn(self, batch: Batch) -> Iterator[tuple[int, AgentBatch]]:
        """Yield each agent's index and its part of the batch, in the order of updates.

        The field ``gain`` is the advantage times the product of the previous agents' ratios, which is at most
        ``max_factor``.
        """
        actor = self.policy.actor
        task = self.policy.actor.one_hot(batch.obs)
        old_log_std = actor.log_std_of(batch.obs).detach().expand(batch.actions.shape)
        columns = [actor.parts(x) for x in (batch.actions, batch.old_means, old_log_std)]
        bound = self.config.max_factor or math.inf
        factor = torch.ones_like(batch.advantages)
        order = torch.randperm(len(self.views), generator=self.order).tolist()
        for agent in order:
            actions, means, log_std = (parts[agent] for parts in columns)
            old_log_probs = gaussian_log_prob(actions, means, log_std)
            gain = batch.advantages * factor.clamp(max=bound)
            seen = actor.seen(agent, batch.obs)
            share = AgentBatch(seen, task, actions, means, log_std, old_log_probs, gain, batch.weights)
            yield agent, share
            if agent != order[-1]:
                factor = factor * self._ratio(agent, share)

    @torch.no_grad()
    def _ratio(self, agent: int, share: AgentBatch) -> Tensor:
        mean, log_std = self._distribution(agent, share)
        return torch.exp(gaussian_log_prob(share.actions, mean, log_std) - share.old_log_probs)

    def _distribution(self, agent: int, share: AgentBatch) -> tuple[Tensor, Tensor]:
        with autocast(self.device, self.low_precision):
            return self.policy.actor.distribution_of(agent, share.seen, share.task)

    def _parts(self) -> Parts:
        return super()._parts() | {"order": self.order}

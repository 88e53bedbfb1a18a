"""What the on-policy learners of several agents share: the agents' policy, a critic of all, its loss.

To the base below it the agents are one policy, whose action is put together of theirs; an update takes it apart again.
"""

import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor, nn

from bidex_algos.multiagent.agent_batch import AgentBatch
from bidex_algos.multiagent.config import MultiAgentConfig
from bidex_algos.multiagent.popart import keep_values
from bidex_algos.multiagent.team import TeamActor
from bidex_algos.nets.encoders.inputs import Inputs
from bidex_algos.nets.networks import gaussian_log_prob
from bidex_algos.nets.normalise import ObservationNormaliser
from bidex_algos.nets.policy import GaussianPolicy
from bidex_algos.nets.precision import autocast, use_bfloat16
from bidex_algos.nets.shape import Shape
from bidex_algos.onpolicy.base import Batch, OnPolicy
from bidex_meta.errors import BidexError
from bidex_meta.train.distributed import sum_gradients
from bidex_meta.world.agent_views import agent_views
from bidex_meta.world.contract import VectorWorld


class TeamPolicy(GaussianPolicy):
    """All agents as one Gaussian policy of the world's action."""

    actor: TeamActor  # type: ignore[assignment]


class MultiAgent(OnPolicy):
    """Agents that share a reward, each with a policy on what it sees.

    Arguments and attributes are those of :class:`~bidex_algos.onpolicy.base.OnPolicy`.

    Attributes:
        views: The agents.
        critic_adam: Moves the critic.
        kl_share: Each agent's part of the KL that all may have together, which is the sum of theirs.

    Raises:
        BidexError: A partition that is none of this world's, policy heads where the world does not show the task, or
            fewer samples in a rollout than mini-batches.
    """

    config: MultiAgentConfig
    policy: TeamPolicy

    def __init__(self, world: VectorWorld, config: MultiAgentConfig, seed: int):
        self.views = agent_views(world.observation_groups, int(world.single_action_space.shape[0]), config.agents)
        self.kl_share = 1.0 / len(self.views)
        samples = config.rollout_steps * world.num_envs
        if samples < config.num_minibatches:
            raise BidexError(
                f"{self.name}: {config.num_minibatches} mini-batches need as many samples, but {world.num_envs} rows x "
                f"{config.rollout_steps} steps give {samples}. Raise num_envs or lower num_minibatches."
            )
        super().__init__(world, config, seed)
        rate, eps = config.critic_learning_rate, config.adam_eps
        self.critic_adam = torch.optim.Adam(self.critic.parameters(), lr=rate, eps=eps, fused=True)

    @classmethod
    def _make_policy(
        cls, config: MultiAgentConfig, shape: Shape, init: torch.Generator, device: torch.device
    ) -> TeamPolicy:
        views, inputs = agent_views(shape.groups, shape.actions, config.agents), Inputs(shape.groups)
        heads, share = shape.num_id_columns if config.policy_heads else 1, getattr(config, "share_parameters", False)
        actor = TeamActor(views, config, inputs, init, heads, share)
        observations = ObservationNormaliser(inputs, config.normalise_observations)
        policy: Any = TeamPolicy(observations, actor, use_bfloat16(config.autocast, device))  # type: ignore[arg-type]
        return policy.to(device)

    # The critic.

    def _critics(self) -> list[Any]:
        """The networks of the critic: one for all, or one an agent."""
        return [self.critic]

    def _merge_returns(self, mean: Tensor, var: Tensor, count: Tensor) -> None:
        stats = self.return_stats
        known, before = stats.count > 0, (stats.mean.clone(), stats.std())
        super()._merge_returns(mean, var, count)
        if self.config.popart:
            after = stats.mean, stats.std()
            # Before the first returns of a task its values are none.
            old_mean, old_std = (torch.where(known, *pair) for pair in zip(before, after, strict=True))
            keep_values(self._critics(), (old_mean, old_std), after)

    def _old_values(self, batch: Batch) -> Tensor:
        """What the critic says of a batch before it is moved, where the loss asks for it."""
        if not self.config.value_clip:
            return batch.targets
        with torch.no_grad():
            return self._critic(batch.obs, batch.task_id)

    def _value_loss(self, b: Batch, old_values: Tensor, weights: Tensor) -> Tensor:
        """The critics' loss, a scalar: twice Huber's of the errors, so that small ones are squared; of several the sum.

        With ``value_clip`` the larger of two: of the value, and of the old value moved towards it as far as that.
        """
        delta, reach = self.config.huber_delta, self.config.value_clip
        values = self._critic(b.obs, b.task_id)

        def huber(values: Tensor) -> Tensor:
            return 2.0 * nn.functional.huber_loss(values, b.targets, reduction="none", delta=delta)

        loss = huber(values)
        if reach:
            loss = torch.maximum(loss, huber(old_values + (values - old_values).clamp(-reach, reach)))
        return (weights.view(-1, *[1] * (loss.dim() - 1)) * loss).sum()

    def _critic_step(self) -> None:
        """One step along the gradients that are there, each network's shortened."""
        for critic in self._critics():
            nn.utils.clip_grad_norm_(critic.parameters(), self.config.max_grad_norm)
        self.critic_adam.step()

    def _critic_epochs(self, batch: Batch, epochs: int, num_minibatches: int, weight: float = 1.0) -> Tensor:
        """Fits the critic to its targets; the mean loss over all mini-batches, a scalar."""
        old_values, losses = self._old_values(batch), list[Tensor]()
        parameters = list(self.critic.parameters())
        for _, index, count in self._mini_batches(batch, epochs, num_minibatches):
            b = batch.select(index)
            loss = self._value_loss(b, old_values.index_select(0, index), b.weights / count)
            self.critic_adam.zero_grad()
            (weight * loss).backward()
            losses.append(sum_gradients(parameters, loss.detach()[None])[0])
            self._critic_step()
        return torch.stack(losses).mean()

    def _optimisers(self) -> dict[str, Any]:
        return {"critic_adam": self.critic_adam}


class Sequential(MultiAgent):
    """Agents that are updated one after another, in a random order (Kuba et al. 2022).

    Each sees the advantage times the ratio, new over old, of all that were before it. The order is drawn alike in all
    processes. All of them learn from the same samples, so that the same few can earn from every one: with twelve agents
    the largest products grew to 20,000 (HAPPO) and 130,000 within an update. ``max_factor`` bounds them.
    """

    config: Any

    def __init__(self, world: VectorWorld, config: MultiAgentConfig, seed: int):
        super().__init__(world, config, seed)
        self.order = torch.Generator().manual_seed(seed)

    def _in_turn(self, batch: Batch) -> Iterator[tuple[int, AgentBatch]]:
        """Gives each agent with its share of the batch, and puts what it did with it into the gain of those after it.

        Yields:
            (agent, share), whose ``gain`` is the advantage times the product of the ratios, at most ``max_factor``; a
            ratio is that of the policy when the next agent is asked for.
        """
        actor, task = self.policy.actor, self.policy.actor.one_hot(batch.obs)
        old_log_std = actor.log_std_of(batch.obs).detach().expand(batch.actions.shape)
        columns = [actor.parts(x) for x in (batch.actions, batch.old_means, old_log_std)]
        bound, factor = self.config.max_factor or math.inf, torch.ones_like(batch.advantages)
        order = torch.randperm(len(self.views), generator=self.order).tolist()
        for agent in order:
            actions, means, log_std = (parts[agent] for parts in columns)
            old_log_probs, gain = gaussian_log_prob(actions, means, log_std), batch.advantages * factor.clamp(max=bound)
            seen = actor.seen(agent, batch.obs)
            share = AgentBatch(seen, task, actions, means, log_std, old_log_probs, gain, batch.weights)
            yield agent, share
            if agent != order[-1]:
                factor = factor * self._ratio(agent, share)

    @torch.no_grad()
    def _ratio(self, agent: int, share: AgentBatch) -> Tensor:
        """The ratio (B,) of an agent's present policy over the sampling one."""
        mean, log_std = self._distribution(agent, share)
        return torch.exp(gaussian_log_prob(share.actions, mean, log_std) - share.old_log_probs)

    def _distribution(self, agent: int, share: AgentBatch) -> tuple[Tensor, Tensor]:
        """Mean (B, a_i) and logarithm of the standard deviation of an agent's present policy, (a_i,) or (B, a_i)."""
        with autocast(self.device, self.low_precision):
            return self.policy.actor.distribution_of(agent, share.seen, share.task)

    def _parts(self) -> dict[str, Any]:
        return super()._parts() | {"order": self.order}

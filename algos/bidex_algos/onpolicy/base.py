"""What the on-policy learners share: rollouts, a critic per task, statistics, checkpoints. They differ in the update.

An iteration collects ``rollout_steps`` steps in every row, makes them a :class:`Batch`, and hands it to the learner.
"""

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from bidex_algos.experience.advantages import (
    discounts,
    explained_variance,
    gae,
    normalise_per_task,
    successor_values,
    task_moments,
)
from bidex_algos.experience.episodes import EpisodeStatistics
from bidex_algos.experience.rollout import Rollout, collect
from bidex_algos.learner import Learner
from bidex_algos.nets.multitask.architecture import network_of
from bidex_algos.nets.networks import GaussianActor, gaussian_log_prob
from bidex_algos.nets.normalise import ObservationNormaliser, RunningStats
from bidex_algos.nets.policy import GaussianPolicy
from bidex_algos.nets.precision import autocast, use_bfloat16
from bidex_algos.nets.shape import Shape
from bidex_algos.onpolicy.config import OnPolicyConfig
from bidex_algos.reports import as_numbers
from bidex_meta.train.distributed import all_sum, world_size
from bidex_meta.world.contract import VectorWorld


@dataclass
class Batch:
    """A rollout made ready for the update, steps and rows flattened into B samples."""

    obs: Tensor
    """Normalised observations (B, d), in the precision the hidden layers run in."""
    task_id: Tensor
    """Task of each sample (B,)."""
    actions: Tensor
    """Sampled actions (B, a)."""
    old_means: Tensor
    """Means of the sampling policy (B, a)."""
    old_log_probs: Tensor
    """Log-density of the actions under the sampling policy (B,)."""
    advantages: Tensor
    """Normalised advantages (B,); of several critics (B, critics)."""
    targets: Tensor
    """What the critic shall predict, in its own units (B,); of several (B, critics)."""
    weights: Tensor
    """1, or 0 for a transition where physics broke (B,)."""

    def select(self, index: Tensor) -> "Batch":
        """The samples at ``index``."""
        return Batch(**{name: value.index_select(0, index) for name, value in vars(self).items()})


class OnPolicy(Learner):
    """A Gaussian policy and a critic that learn from what the policy has just done.

    Arguments, attributes and errors are those of :class:`~bidex_algos.learner.Learner`.

    Attributes:
        policy: The agent that evaluation uses: mean action, clamped.
        critic: Values of normalised observations, in units of the task's returns.
        gamma: Discount of all rows, or of each (N,).
        num_critics: How many values a state has: more than one where each of several agents has a critic of its own.
    """

    config: OnPolicyConfig
    policy: GaussianPolicy
    discounts_by_class = True
    per_process = ("generator", "episodes", "obs")
    num_critics = 1

    def __init__(self, world: VectorWorld, config: OnPolicyConfig, seed: int):
        super().__init__(world, config, seed)
        self.low_precision = self.policy.low_precision
        self.obs: Tensor | None = None
        self.critic = self._make_critic(world.num_tasks if config.value_heads else 1).to(self.device)
        horizon = config.value_horizon * config.rollout_steps * world.num_envs * world_size() / world.num_tasks
        self.return_stats = RunningStats((self.num_critics * world.num_tasks,), max_count=horizon).to(self.device)
        self.gamma = discounts(world, config.gamma, world.task_id)
        sizes = self.shape.observations, self.shape.actions
        self.rollout = Rollout(config.rollout_steps, world.num_envs, *sizes, self.device, self.num_critics)
        self.episodes = EpisodeStatistics(world.task_id, world.task_names)

    # What a learner adds.

    def _make_critic(self, heads: int) -> nn.Module:
        """The critic, with one output per task or one for all."""
        make = network_of(self.config)
        return make(self.inputs, self.config.hidden, heads, 1.0, self.initial, self.config.activation)

    @abstractmethod
    def _update(self, batch: Batch) -> dict[str, Tensor]:
        """Learns from a batch; returns scalars to be logged."""

    @abstractmethod
    def _optimisers(self) -> dict[str, Any]:
        """The optimisers by their names in a checkpoint."""

    def _iterate(self) -> dict[str, float]:
        """Collects one rollout and learns from it."""
        with self._collecting():
            if self.obs is None:
                self.obs = self._first_observations()
            self.obs = collect(self.world, self.rollout, self.obs, self._sample, self._final_value, self.episodes)
        batch, explained = self._prepare()
        losses = self._update(batch)
        self.policy.observations.update(self.rollout.obs)
        self.env_steps += self.rollout.rewards.numel() * world_size()
        return self._metrics(losses, explained)

    # The rollout.

    def _sample(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_std = self.policy.distribution(obs)
        noise = torch.randn(mean.shape, generator=self.generator, device=self.device)
        # Not clamped: the world does that, and the density must be that of what was drawn.
        return mean + log_std.exp() * noise, mean

    def _final_value(self, obs: Tensor, task_id: Tensor) -> Tensor:
        return self._in_reward_units(self._critic(self.policy.observations(obs), task_id), task_id)

    # Values. The critic speaks in units of its task's running mean and deviation of returns.

    def _critic(self, obs: Tensor, task_id: Tensor) -> Tensor:
        with autocast(self.device, self.low_precision):
            out = self.critic(obs)
        if self.config.value_heads:
            return out.gather(1, task_id[:, None]).squeeze(1)
        return out.squeeze(1)

    def _element(self, task_id: Tensor) -> Tensor:
        """Where the returns of a task (B,) stand in the statistics: (B,), of several critics (B, critics)."""
        if self.num_critics == 1:
            return task_id
        return task_id[:, None] + self.world.num_tasks * torch.arange(self.num_critics, device=self.device)

    def _in_reward_units(self, values: Tensor, task_id: Tensor) -> Tensor:
        return self.return_stats.restore(values, self._element(task_id)) if self.config.per_task_values else values

    def _in_critic_units(self, returns: Tensor, task_id: Tensor) -> Tensor:
        return self.return_stats.normalise(returns, self._element(task_id)) if self.config.per_task_values else returns

    def _merge_returns(self, mean: Tensor, var: Tensor, count: Tensor) -> None:
        """Takes a rollout's moments of returns into the statistics, which are the critic's units from now on."""
        self.return_stats.merge(mean, var, count)

    def _mini_batches(self, batch: Any, epochs: int, number: int) -> Iterator[tuple[bool, Tensor, Tensor]]:
        """Some passes over a batch, shuffled anew in each: whether it is the very first, samples (b,), and their count.

        Of ``batch`` the weights (B,) are read alone.
        Divided by that count, of all processes, losses and gradients become means by being summed over them.
        """
        for epoch in range(epochs):
            order = torch.randperm(len(batch.weights), generator=self.generator, device=self.device)
            parts = order.chunk(number)
            counts = all_sum(torch.stack([batch.weights[index].sum() for index in parts])).clamp_min(1.0)
            for place, (index, count) in enumerate(zip(parts, counts, strict=True)):
                yield (epoch, place) == (0, 0), index, count

    @torch.no_grad()
    def _prepare(self) -> tuple[Batch, Tensor]:
        """Turns the rollout into a batch; also the explained variance per task (num_tasks,)."""
        r, cfg, num_tasks = self.rollout, self.config, self.world.num_tasks
        steps, rows = r.rewards.shape
        task_id = self.world.task_id
        flat_task_id = task_id.expand(steps, rows).reshape(-1)
        obs = self.policy.observations(r.obs).flatten(0, 1)
        if self.low_precision:
            # Autocast would make this cast in every mini-batch; the result is the same.
            obs = obs.bfloat16()

        # Several critics make several columns of a row, each like a row of its own.
        def each(x: Tensor) -> Tensor:
            return x if self.num_critics == 1 else x.repeat_interleave(self.num_critics, 1)

        judged = self._in_reward_units(self._critic(obs, flat_task_id), flat_task_id)
        values, last_values = judged.view(steps, -1), self._final_value(r.last_obs, task_id).view(-1)
        rewards, terminated, ended, valid = map(each, (r.rewards, r.terminated, r.ended, r.valid))
        element, elements = self._element(task_id).reshape(-1), self.num_critics * num_tasks
        next_values = successor_values(values, last_values, ended, r.final_values.flatten(1))
        gamma = each(self.gamma[None]) if isinstance(self.gamma, Tensor) else self.gamma
        advantages = gae(rewards, values, next_values, terminated, ended, gamma, cfg.lam, valid)
        returns = advantages + values
        explained = explained_variance(values, returns, element, elements, valid).view(-1, num_tasks).mean(0)
        self._merge_returns(*task_moments(returns, element, elements, valid))
        group = element if cfg.per_task_advantages else element // num_tasks * num_tasks
        advantages = normalise_per_task(advantages, group, elements, valid)

        actions, old_means = r.actions.flatten(0, 1), r.means.flatten(0, 1)
        batch = Batch(
            obs=obs,
            task_id=flat_task_id,
            actions=actions,
            old_means=old_means,
            old_log_probs=gaussian_log_prob(actions, old_means, self.policy.actor.log_std_of(obs)),
            advantages=advantages.reshape(judged.shape),
            targets=self._in_critic_units(returns.reshape(judged.shape), flat_task_id),
            weights=r.valid.flatten().float(),
        )
        return batch, explained

    def _metrics(self, losses: dict[str, Tensor], explained: Tensor) -> dict[str, float]:
        tensors = dict(losses)
        tensors["Policy/std"] = self.policy.actor.log_std.detach().exp().mean()
        tensors["Train/unstable"] = all_sum((~self.rollout.valid).sum())
        for name, value in zip(self.world.task_names, explained, strict=True):
            tensors[f"Value/explained_variance/{name}"] = value
        return self.episodes.metrics() | as_numbers(tensors)

    # Checkpoints.

    @classmethod
    def _make_policy(
        cls, config: OnPolicyConfig, shape: Shape, init: torch.Generator, device: torch.device
    ) -> GaussianPolicy:
        inputs, heads = cls._inputs(config, shape), shape.num_id_columns if config.policy_heads else 1
        sizes, network = (config.hidden, shape.actions, config.init_std), network_of(config)
        actor = GaussianActor(inputs, *sizes, init, config.activation, heads, network)
        observations = ObservationNormaliser(inputs, config.normalise_observations)
        return GaussianPolicy(observations, actor, use_bfloat16(config.autocast, device)).to(device)

    def _parts(self) -> dict[str, Any]:
        return {
            "critic": self.critic,
            "return_stats": self.return_stats,
            **self._optimisers(),
            "generator": self.generator,
            "episodes": self.episodes,
        }

    def _place(self) -> dict[str, Any]:
        return {"obs": self.obs, **super()._place()}

    def _go_on_from(self, state: dict[str, Any]) -> None:
        super()._go_on_from(state)
        self.obs = None if state["obs"] is None else state["obs"].to(self.device, copy=True)

    def _check_size(self, state: dict[str, Any]) -> None:
        if state["obs"] is not None:
            expected = tuple(self.rollout.last_obs.shape)
            self._expect("(num_envs, observations) = ", tuple(state["obs"].shape), expected)

"""What the on-policy learners share: rollouts, a critic per task, statistics, checkpoints. They differ in the update.

An iteration collects ``rollout_steps`` steps in every row, makes them a :class:`Batch`, and hands it to the learner.
"""

import copy
import time
from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from bidex_algos.experience.advantages import (
    explained_variance,
    gae,
    normalise_per_task,
    successor_values,
    task_moments,
)
from bidex_algos.experience.episodes import EpisodeStatistics
from bidex_algos.experience.rollout import Rollout, VectorWorld, check_autoreset, collect
from bidex_algos.nets.networks import MLP, GaussianActor, gaussian_log_prob
from bidex_algos.nets.normalise import ObservationNormaliser, RunningStats
from bidex_algos.nets.policy import GaussianPolicy
from bidex_algos.nets.precision import autocast, use_bfloat16
from bidex_algos.onpolicy.config import OnPolicyConfig
from bidex_algos.reports import as_numbers, check_finite
from bidex_meta.errors import BidexError
from bidex_meta.train.distributed import all_sum, broadcast, own_seed, world_size


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
    """Normalised advantages (B,)."""
    targets: Tensor
    """What the critic shall predict, in its own units (B,)."""
    weights: Tensor
    """1, or 0 for a transition where physics broke (B,)."""

    def select(self, index: Tensor) -> "Batch":
        """The samples at ``index``."""
        return Batch(**{name: value.index_select(0, index) for name, value in vars(self).items()})


class OnPolicy(ABC):
    """A Gaussian policy and a critic that learn from what the policy has just done.

    In a run of several processes each has a world and samples of its own, and all have the same networks: statistics
    and gradients are those of the samples of all.

    Args:
        world: A world that resets finished rows within the step.
        config: The learner's config.
        seed: Of the initial weights, the sampled actions, the shuffling and the world's first reset.

    Attributes:
        env_steps: Environment steps taken so far, over all rows of all processes.
        per_process: Entries of ``state_dict`` that differ from process to process.
        policy: The agent that evaluation uses: mean action, clamped.

    Raises:
        BidexError: Policy heads for a world that does not show the task.
    """

    name: ClassVar[str]
    """How the learner calls itself in messages."""
    remedy: ClassVar[str]
    """What helps, mostly, when a loss is no longer finite."""
    config_type: ClassVar[type[OnPolicyConfig]]
    """Its config."""
    per_process: ClassVar[tuple[str, ...]] = ("generator", "episodes", "obs")

    def __init__(self, world: VectorWorld, config: Any, seed: int):
        check_autoreset(world, self.name, "SAME_STEP")
        self.world, self.config, self.seed = world, config, seed
        self.device = torch.device(world.device)
        self.low_precision = use_bfloat16(config.autocast, self.device)
        self.env_steps = 0
        self.obs: Tensor | None = None
        d, a = int(world.single_observation_space.shape[0]), int(world.single_action_space.shape[0])
        num_id_columns = int(getattr(world, "num_id_columns", 0))
        if config.policy_heads and num_id_columns != world.num_tasks:
            raise BidexError(
                f"{self.name}: policy_heads needs a world that shows the task as a one-hot (an MT suite), but this one "
                f"has {num_id_columns} such columns for {world.num_tasks} tasks. Leave policy_heads off."
            )
        self.shape = {"observations": d, "actions": a, "num_id_columns": num_id_columns}

        # Weights come from a CPU generator, so that a seed means the same network on every device.
        init = torch.Generator().manual_seed(seed)
        self.generator = torch.Generator(self.device).manual_seed(own_seed(seed))
        self.policy = _make_policy(config, self.shape, init, self.low_precision).to(self.device)
        value_heads = world.num_tasks if config.value_heads else 1
        self.critic = MLP(d, config.hidden, value_heads, 1.0, init, config.activation).to(self.device)
        samples = config.rollout_steps * world.num_envs
        horizon = config.value_horizon * samples * world_size() / world.num_tasks
        self.return_stats = RunningStats((world.num_tasks,), max_count=horizon).to(self.device)
        self.rollout = Rollout(config.rollout_steps, world.num_envs, d, a, self.device)
        self.episodes = EpisodeStatistics(world.task_id, world.task_names)

    # What a learner adds.

    @abstractmethod
    def _update(self, batch: Batch) -> dict[str, Tensor]:
        """Learns from a batch; returns scalars to be logged."""

    @abstractmethod
    def _optimiser_state(self) -> dict[str, Any]:
        """The optimisers' part of a checkpoint."""

    @abstractmethod
    def _load_optimisers(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`_optimiser_state` gave, from a whole checkpoint."""

    def iterate(self) -> dict[str, float]:
        """Collects one rollout and learns from it.

        Returns:
            Metrics under TensorBoard-like tags; ``docs/learners/`` explains each.

        Raises:
            FloatingPointError: The loss is no longer finite.
        """
        started = time.perf_counter()
        if self.obs is None:
            # The same seed has given the same weights everywhere, unless a machine computes differently.
            broadcast([*self.policy.parameters(), *self.critic.parameters()])
            self.obs, _ = self.world.reset(seed=own_seed(self.seed))
            self.policy.observations.update(self.obs)
        self.obs = collect(self.world, self.rollout, self.obs, self._sample, self._final_value, self.episodes)
        collected = time.perf_counter()

        batch, explained = self._prepare()
        losses = self._update(batch)
        self.policy.observations.update(self.rollout.obs)
        steps = self.rollout.rewards.numel() * world_size()
        self.env_steps += steps
        metrics = self._metrics(losses, explained)
        done = time.perf_counter()
        metrics["Perf/collection_time"] = collected - started
        metrics["Perf/learning_time"] = done - collected
        metrics["Perf/steps_per_second"] = steps / (done - started)
        return metrics

    def eval_action(self, obs: Tensor) -> Tensor:
        """Mean action for raw observations (N, d), clamped to [-1, 1], (N, a). N need not be the training world's."""
        return self.policy.eval_action(obs)

    def reset(self, env_mask: Tensor) -> None:
        """A new episode begins in the rows of ``env_mask``, bool (N,)."""
        self.policy.reset(env_mask)

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

    def _in_reward_units(self, values: Tensor, task_id: Tensor) -> Tensor:
        if not self.config.per_task_values:
            return values
        return values * self.return_stats.std().float()[task_id] + self.return_stats.mean.float()[task_id]

    def _in_critic_units(self, returns: Tensor, task_id: Tensor) -> Tensor:
        if not self.config.per_task_values:
            return returns
        return (returns - self.return_stats.mean.float()[task_id]) / self.return_stats.std().float()[task_id]

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

        values = self._in_reward_units(self._critic(obs, flat_task_id), flat_task_id).view(steps, rows)
        last_values = self._final_value(r.last_obs, task_id)
        next_values = successor_values(values, last_values, r.ended, r.final_values)
        advantages = gae(r.rewards, values, next_values, r.terminated, r.ended, cfg.gamma, cfg.lam, r.valid)
        returns = advantages + values
        explained = explained_variance(values, returns, task_id, num_tasks, r.valid)
        self.return_stats.merge(*task_moments(returns, task_id, num_tasks, r.valid))
        group = task_id if cfg.per_task_advantages else torch.zeros_like(task_id)
        advantages = normalise_per_task(advantages, group, num_tasks, r.valid)

        actions, old_means = r.actions.flatten(0, 1), r.means.flatten(0, 1)
        batch = Batch(
            obs=obs,
            task_id=flat_task_id,
            actions=actions,
            old_means=old_means,
            old_log_probs=gaussian_log_prob(actions, old_means, self.policy.actor.log_std_of(obs)),
            advantages=advantages.flatten(),
            targets=self._in_critic_units(returns.flatten(), flat_task_id),
            weights=r.valid.flatten().float(),
        )
        return batch, explained

    def _metrics(self, losses: dict[str, Tensor], explained: Tensor) -> dict[str, float]:
        tensors = dict(losses)
        tensors["Policy/std"] = self.policy.actor.log_std.detach().exp().mean()
        tensors["Train/unstable"] = all_sum((~self.rollout.valid).sum())
        for name, value in zip(self.world.task_names, explained, strict=True):
            tensors[f"Value/explained_variance/{name}"] = value
        metrics = self.episodes.metrics() | as_numbers(tensors)
        check_finite(metrics, losses, self.name, self.env_steps, self.remedy)
        return metrics

    # Checkpoints.

    def policy_state_dict(self) -> dict[str, Any]:
        """What :meth:`load_policy` needs: network, observation statistics, sizes and config."""
        return {"config": asdict(self.config), "shape": dict(self.shape), "weights": self.policy.state_dict()}

    @classmethod
    def load_policy(cls, state: dict[str, Any], device: str | torch.device = "cpu") -> GaussianPolicy:
        """The agent of a checkpoint, for a world of any number of rows.

        Args:
            state: ``checkpoint["learner"]["policy"]``.
            device: Where to run it.
        """
        config, device = cls.config_type(**state["config"]), torch.device(device)
        init = torch.Generator().manual_seed(0)
        policy = _make_policy(config, state["shape"], init, use_bfloat16(config.autocast, device)).to(device)
        policy.load_state_dict(state["weights"])
        return policy

    def state_dict(self) -> dict[str, Any]:
        """A copy of everything but the world, as tensors and plain values (``torch.load(weights_only=True)``)."""
        return copy.deepcopy(
            {
                "policy": self.policy_state_dict(),
                "critic": self.critic.state_dict(),
                "return_stats": self.return_stats.state_dict(),
                **self._optimiser_state(),
                "generator": self.generator.get_state(),
                "episodes": self.episodes.state_dict(),
                "obs": self.obs,
                "env_steps": self.env_steps,
            }
        )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave.

        Raises:
            BidexError: The checkpoint comes from a world of another size.
        """
        obs = state["obs"]
        expected = tuple(self.rollout.last_obs.shape)
        if obs is not None and tuple(obs.shape) != expected:
            raise BidexError(
                f"{self.name}: the checkpoint's world had (num_envs, observations) = {tuple(obs.shape)}, this one has "
                f"{expected}. Resume with the run's own suite and num_envs."
            )
        self.policy.load_state_dict(state["policy"]["weights"])
        self.critic.load_state_dict(state["critic"])
        self.return_stats.load_state_dict(state["return_stats"])
        self._load_optimisers(state)
        self.generator.set_state(state["generator"].cpu())
        self.episodes.load_state_dict(state["episodes"])
        self.obs = None if obs is None else obs.to(self.device, copy=True)
        self.env_steps = int(state["env_steps"])


def _make_policy(
    config: OnPolicyConfig, shape: dict[str, int], init: torch.Generator, low_precision: bool
) -> GaussianPolicy:
    d, ids = shape["observations"], shape["num_id_columns"]
    heads = ids if config.policy_heads else 1
    actor = GaussianActor(d, config.hidden, shape["actions"], config.init_std, init, config.activation, heads)
    return GaussianPolicy(ObservationNormaliser(d, ids, config.normalise_observations), actor, low_precision)

"""Base of the on-policy learners: options, the batch of a rollout, and an iteration around each learner's own update.

The steps of algorithm 1 of Schulman et al. (2017) are numbered from ``OnPolicy._iterate`` to ``MTPPO._descend``.
"""

from abc import abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from bidex_algos import advantages as estimates
from bidex_algos.learner import Learner, as_numbers
from bidex_algos.nets.architecture import Architecture, check_networks, network_bytes, network_of
from bidex_algos.nets.networks import Activation, Autocast, Layers, autocast, gaussian_log_prob
from bidex_algos.nets.normalise import RunningStats
from bidex_algos.nets.policy import GaussianPolicy, gaussian_policy, of_head
from bidex_algos.rollout import EpisodeStatistics, Rollout, collect_rollout
from bidex_meta.training.distributed import all_sum, world_size
from bidex_meta.training.learner import Capability, LearnerConfig, Parts, State
from bidex_meta.utils.validation import Count, Fraction, Positive, Widths, check_rising
from bidex_meta.world.contract import VectorWorld

_VALUE_HORIZON = 100.0  # iterations over which old returns fade from the statistics that define the critic's units


@dataclass(frozen=True)
class OnPolicyConfig(LearnerConfig):
    """Options of networks, rollouts and statistics; the defaults are the preset ``laptop``."""

    architecture: Architecture = "shared"
    """shared: one trunk for all tasks. multi_head: the same trunk with policy_heads and value_heads. towers: tasks
    share only the first layer. separate: tasks share no layer. soft_modules, paco, moore, transformer: other trunks,
    each with or without heads. All except shared need an MT suite, whose observations show the task."""
    hidden: Layers = (256, 256, 128)  # Widths of the hidden layers, the same for actor and critic.
    activation: Activation = "elu"  # Non-linearity of the hidden layers.
    policy_heads: bool = False  # Give the actor an output layer per task; the world must show the task's one-hot.
    value_heads: bool = True  # Give the critic one output per task instead of one for all.
    point_widths: Widths = (32, 64)
    """Widths of the layers that all points of a point cloud share (PointNet), if the world shows a point cloud."""
    init_std: Positive = 0.8  # Initial standard deviation of the actions.
    std_range: tuple[Positive, Positive] = (0.05, 1.5)  # Bounds of the standard deviation of the actions.
    rollout_steps: Count = 8  # Steps in every environment between two updates.
    gamma: Fraction = 0.93  # Discount factor per step.
    lam: Fraction = 0.95  # Lambda of generalised advantage estimation.
    normalise_observations: bool = True
    """Give observations zero mean and unit variance by running statistics; the task's one-hot is not changed."""
    autocast: Autocast = "auto"  # Use bfloat16 in hidden layers; auto: on CUDA and on CPUs with AMX or AVX-512's BF16.

    def __post_init__(self) -> None:
        super().__post_init__()
        check_networks(self)
        check_rising(self, self.algo, "std_range")

    def bytes_held(self, num_envs: int, width: int) -> int:
        """Estimate the memory that the learner takes, in bytes, if it stores ``width`` numbers per environment step."""
        return 4 * num_envs * width * self.rollout_steps + network_bytes(self.hidden, width, 2)


@dataclass
class Batch:
    """A rollout prepared for the update, with steps and rows flattened into B samples."""

    obs: Tensor  # normalised observations (B, d), in the precision of the hidden layers
    task_id: Tensor  # task of each sample (B,)
    actions: Tensor  # sampled actions (B, a)
    old_means: Tensor  # means of the sampling policy (B, a)
    old_log_probs: Tensor  # log-density of the actions under the sampling policy (B,)
    advantages: Tensor  # normalised advantages (B,); with several critics (B, critics)
    targets: Tensor  # the critic's targets: normalised returns (B,); with several critics (B, critics)
    weights: Tensor  # 0 if physics broke in the transition, otherwise 1 (B,)

    def select(self, index: Tensor) -> "Batch":
        """Return the samples of this batch at ``index``."""
        return Batch(**{name: value.index_select(0, index) for name, value in vars(self).items()})


class OnPolicy(Learner):
    """A Gaussian policy and a critic (``num_critics`` values of a state) that learn from the latest rollout."""

    config: OnPolicyConfig
    policy: GaussianPolicy
    capabilities = frozenset({Capability.DISCOUNTS_BY_CLASS})
    per_process = ("generator", "episodes", "obs")
    going_on = ("obs", *Learner.going_on)
    policy_of = staticmethod(gaussian_policy)
    num_critics = 1

    def __init__(self, world: VectorWorld, config: OnPolicyConfig, seed: int):
        super().__init__(world, config, seed)
        self.low_precision = self.policy.low_precision
        self.obs: Tensor | None = None
        self.critic = self._make_critic(world.num_tasks if config.value_heads else 1).to(self.device)
        horizon = _VALUE_HORIZON * config.rollout_steps * world.num_envs * world_size() / world.num_tasks
        self.return_stats = RunningStats((self.num_critics * world.num_tasks,), max_count=horizon).to(self.device)
        self.gamma = estimates.discounts(world, config.gamma, world.task_id)
        sizes = self.shape.observations, self.shape.actions
        self.rollout = Rollout(config.rollout_steps, world.num_envs, *sizes, self.device, self.num_critics)
        self.episodes = EpisodeStatistics(world.task_id, world.task_names)

    def _make_critic(self, heads: int) -> nn.Module:
        config = self.config
        return network_of(config)(self.inputs, config.hidden, heads, 1.0, self.initial, config.activation)

    @abstractmethod
    def _update(self, batch: Batch) -> dict[str, Tensor]:
        """Learn from a batch; return scalars to be logged."""

    @abstractmethod
    def _optimisers(self) -> Parts:
        """Return the optimisers by their names in a checkpoint."""

    def _iterate(self) -> dict[str, float]:
        # Step 1: collect a rollout with the current policy.
        with self._collecting():
            if self.obs is None:
                self.obs = self._first_observations()
            self.obs = collect_rollout(
                self.world, self.rollout, self.obs, self._sample, self._final_value, self.episodes
            )
        # Step 2: compute advantages and the critic's targets.
        batch, explained = self._prepare()
        # Steps 3 to 6: learn from them.
        losses = self._update(batch)
        self.policy.observations.update(self.rollout.obs)
        self.env_steps += self.rollout.rewards.numel() * world_size()
        return self._metrics(losses, explained)

    def _sample(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_std = self.policy.distribution(obs)
        noise = torch.randn(mean.shape, generator=self.generator, device=self.device)
        # The action is not clamped: the world clamps it, and the density must be of the sampled action.
        return mean + log_std.exp() * noise, mean

    def _final_value(self, obs: Tensor, task_id: Tensor) -> Tensor:
        return self._in_reward_units(self._critic(self.policy.observations(obs), task_id), task_id)

    # The unit of the critic's values is given by its task's running mean and standard deviation of returns.
    def _critic(self, obs: Tensor, task_id: Tensor) -> Tensor:
        with autocast(self.device, self.low_precision):
            out = self.critic(obs)
        if self.config.value_heads:
            return of_head(out, task_id)
        return out.squeeze(1)

    def _element(self, task_id: Tensor) -> Tensor:
        if self.num_critics == 1:
            return task_id
        return task_id[:, None] + self.world.num_tasks * torch.arange(self.num_critics, device=self.device)

    def _in_reward_units(self, values: Tensor, task_id: Tensor) -> Tensor:
        return self.return_stats.restore(values, self._element(task_id))

    def _merge_returns(self, mean: Tensor, var: Tensor, count: Tensor) -> None:
        self.return_stats.merge(mean, var, count)

    @torch.no_grad()
    def _prepare(self) -> tuple[Batch, Tensor]:
        """Return the batch, and the share of the returns' variance that the critic explains, (num_tasks,)."""
        r = self.rollout
        task_id = self.world.task_id.expand(r.rewards.shape).reshape(-1)
        obs = self.policy.observations(r.obs).flatten(0, 1)
        if self.low_precision:
            obs = obs.bfloat16()  # autocast would make this cast in every mini-batch; the result is the same
        values = self._in_reward_units(self._critic(obs, task_id), task_id)  # (B,) or (B, critics)
        advantages, returns, explained = self._advantages(values.view(len(r.rewards), -1))
        actions = r.actions.flatten(0, 1)
        old_means = r.means.flatten(0, 1)
        batch = Batch(
            obs=obs, task_id=task_id, actions=actions, old_means=old_means,
            old_log_probs=gaussian_log_prob(actions, old_means, self.policy.actor.log_std_of(obs)),
            advantages=advantages.reshape(values.shape),
            targets=self.return_stats.normalise(returns.reshape(values.shape), self._element(task_id)),
            weights=r.valid.flatten().float()
        )  # fmt: skip
        return batch, explained

    def _advantages(self, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return normalised advantages and returns of the rollout, and the explained variance, (num_tasks,).

        ``values`` are in units of reward. Values, advantages and returns are (T, N * critics): each critic of an
        environment has a column of its own. The statistics of returns take in the new returns.
        """
        r = self.rollout
        task_id = self.world.task_id

        def repeated(x: Tensor) -> Tensor:
            return x.repeat_interleave(self.num_critics, 1)

        rewards = repeated(r.rewards)
        terminated = repeated(r.terminated)
        ended = repeated(r.ended)
        valid = repeated(r.valid)
        gamma = self.gamma
        if isinstance(gamma, Tensor):
            gamma = repeated(gamma[None])
        last_values = self._final_value(r.last_obs, task_id).view(-1)
        next_values = estimates.successor_values(values, last_values, ended, r.final_values.flatten(1))
        advantages = estimates.gae(rewards, values, next_values, terminated, ended, gamma, self.config.lam, valid)
        returns = advantages + values
        element = self._element(task_id).reshape(-1)
        elements = self.num_critics * self.world.num_tasks
        explained = estimates.explained_variance(values, returns, element, elements, valid)
        self._merge_returns(*estimates.task_moments(returns, element, elements, valid))
        advantages = estimates.normalise_per_task(advantages, element, elements, valid)
        return advantages, returns, explained.view(-1, self.world.num_tasks).mean(0)

    def _metrics(self, losses: dict[str, Tensor], explained: Tensor) -> dict[str, float]:
        tensors = dict(losses)
        tensors["Policy/std"] = self.policy.actor.log_std.detach().exp().mean()
        tensors["Train/unstable"] = all_sum((~self.rollout.valid).sum())
        for name, value in zip(self.world.task_names, explained, strict=True):
            tensors[f"Value/explained_variance/{name}"] = value
        return self.episodes.metrics() | as_numbers(tensors)

    def _parts(self) -> Parts:
        learned = {"critic": self.critic, "return_stats": self.return_stats, **self._optimisers()}
        return learned | {"generator": self.generator, "episodes": self.episodes}

    def _check_size(self, state: State) -> None:
        if state["obs"] is not None:
            here = tuple(self.rollout.last_obs.shape)
            self._expect("(num_envs, observations) = ", tuple(state["obs"].shape), here)

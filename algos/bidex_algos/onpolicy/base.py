"""The base of the on-policy learners: rollouts as a :class:`Batch`, a critic per task, statistics, checkpoints."""

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from bidex_algos import advantages as estimates
from bidex_algos.learner import Learner, as_numbers
from bidex_algos.nets.architecture import ArchitectureConfig, NetworkConfig, Options, network_bytes, network_of
from bidex_algos.nets.networks import Activation, Autocast, Layers, autocast, gaussian_log_prob
from bidex_algos.nets.normalise import RunningStats
from bidex_algos.nets.policy import GaussianPolicy, gaussian_policy, of_head
from bidex_algos.onpolicy.ppo import mini_batches
from bidex_algos.rollout import EpisodeStatistics, Rollout, collect
from bidex_meta.errors import BidexError
from bidex_meta.training.distributed import all_sum, world_size
from bidex_meta.training.learner import Capability, Parts, State
from bidex_meta.utils.validation import Count, Fraction, Positive, check_rising
from bidex_meta.world.contract import VectorWorld


@dataclass(frozen=True)
class _ValueHeads(ArchitectureConfig):
    value_heads: bool = True  # Give the critic one output per task instead of one for all.


@dataclass(frozen=True)
class OnPolicyConfig(NetworkConfig, _ValueHeads):
    """Options of networks, rollouts and statistics; the defaults are the preset ``laptop``."""

    hidden: Layers = (256, 256, 128)  # Widths of the hidden layers, of actor and critic alike.
    activation: Activation = "elu"  # Non-linearity of the hidden layers.
    init_std: Positive = 0.8  # Standard deviation of the actions at the start.
    std_range: tuple[Positive, Positive] = (0.05, 1.5)  # Bounds of the standard deviation of the actions.
    rollout_steps: Count = 8  # Steps taken in every environment between two updates.
    gamma: Fraction = 0.93  # Discount per step.
    lam: Fraction = 0.95  # Trace decay of the advantage estimate.
    normalise_observations: bool = True
    """Give observations zero mean and unit variance by running statistics; the task's one-hot stays as it is."""
    per_task_values: bool = True  # Let the critic predict returns normalised per task by running statistics.
    value_horizon: Positive = 100.0  # Iterations after which returns fade from those statistics.
    per_task_advantages: bool = True  # Normalise advantages within each task instead of over the whole batch.
    autocast: Autocast = "auto"  # Hidden layers in bfloat16; auto: on CUDA and on CPUs with AMX or AVX-512's BF16.

    def __post_init__(self) -> None:
        super().__post_init__()
        check_rising(self, self.algo, "std_range")

    def bytes_held(self, num_envs: int, width: int) -> int:
        """Estimate the bytes of memory as in the base class."""
        return 4 * num_envs * width * self.rollout_steps + network_bytes(self.hidden, width, 2)


TABLE_47: Options = {
    "hidden": (2048, 1024, 512), "value_heads": False, "init_std": 0.8, "rollout_steps": 8, "num_minibatches": 4,
    "gamma": 0.96, "lam": 0.95, "max_grad_norm": 1.0, "normalise_observations": False,
}  # fmt: skip
"""Networks, rollouts and returns of MT-PPO in the Bi-DexHands appendix."""


@dataclass
class Batch:
    """A rollout prepared for the update, with steps and rows flattened into B samples."""

    obs: Tensor  # normalised observations (B, d), in the precision the hidden layers run in
    task_id: Tensor  # task of each sample (B,)
    actions: Tensor  # sampled actions (B, a)
    old_means: Tensor  # means of the sampling policy (B, a)
    old_log_probs: Tensor  # log-density of the actions under the sampling policy (B,)
    advantages: Tensor  # normalised advantages (B,); of several critics (B, critics)
    targets: Tensor  # what the critic shall predict, in its own units (B,); of several (B, critics)
    weights: Tensor  # 1, or 0 for a transition where physics broke (B,)

    def select(self, index: Tensor) -> "Batch":
        """Return the samples at ``index``."""
        return Batch(**{name: value.index_select(0, index) for name, value in vars(self).items()})


def check_samples(name: str, rollout_steps: int, num_envs: int, num_minibatches: int) -> None:
    """Raise BidexError if a rollout has fewer samples than mini-batches."""
    samples = rollout_steps * num_envs
    if samples < num_minibatches:
        raise BidexError(
            f"{name}: {num_minibatches} mini-batches need as many samples, but {num_envs} environments x "
            f"{rollout_steps} steps give {samples}. Raise num_envs or lower num_minibatches."
        )


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
        horizon = config.value_horizon * config.rollout_steps * world.num_envs * world_size() / world.num_tasks
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
        with self._collecting():
            if self.obs is None:
                self.obs = self._first_observations()
            self.obs = collect(self.world, self.rollout, self.obs, self._sample, self._final_value, self.episodes)
        batch, explained = self._prepare()
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

    # Values. The critic's unit is given by its task's running mean and standard deviation of returns.

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
        if self.config.per_task_values:
            return self.return_stats.restore(values, self._element(task_id))
        return values

    def _in_critic_units(self, returns: Tensor, task_id: Tensor) -> Tensor:
        if self.config.per_task_values:
            return self.return_stats.normalise(returns, self._element(task_id))
        return returns

    def _merge_returns(self, mean: Tensor, var: Tensor, count: Tensor) -> None:
        self.return_stats.merge(mean, var, count)

    def _mini_batches(self, weights: Tensor, epochs: int, number: int) -> Iterator[tuple[bool, Tensor, Tensor]]:
        return mini_batches(weights, epochs, number, self.generator)

    @torch.no_grad()
    def _prepare(self) -> tuple[Batch, Tensor]:
        r = self.rollout
        cfg = self.config
        num_tasks = self.world.num_tasks
        steps, rows = r.rewards.shape
        task_id = self.world.task_id
        flat_task_id = task_id.expand(steps, rows).reshape(-1)
        obs = self.policy.observations(r.obs).flatten(0, 1)
        if self.low_precision:
            obs = obs.bfloat16()  # autocast would make this cast in every mini-batch; the result is the same

        # Several critics make several columns per row, each treated as a separate row.
        def each(x: Tensor) -> Tensor:
            if self.num_critics == 1:
                return x
            return x.repeat_interleave(self.num_critics, 1)

        judged = self._in_reward_units(self._critic(obs, flat_task_id), flat_task_id)
        values = judged.view(steps, -1)
        last_values = self._final_value(r.last_obs, task_id).view(-1)
        rewards, terminated, ended, valid = map(each, (r.rewards, r.terminated, r.ended, r.valid))
        element = self._element(task_id).reshape(-1)
        elements = self.num_critics * num_tasks
        next_values = estimates.successor_values(values, last_values, ended, r.final_values.flatten(1))
        if isinstance(self.gamma, Tensor):
            gamma = each(self.gamma[None])
        else:
            gamma = self.gamma
        advantages = estimates.gae(rewards, values, next_values, terminated, ended, gamma, cfg.lam, valid)
        returns = advantages + values
        explained = estimates.explained_variance(values, returns, element, elements, valid)
        self._merge_returns(*estimates.task_moments(returns, element, elements, valid))
        if cfg.per_task_advantages:
            group = element
        else:
            group = element // num_tasks * num_tasks
        advantages = estimates.normalise_per_task(advantages, group, elements, valid)
        actions = r.actions.flatten(0, 1)
        old_means = r.means.flatten(0, 1)
        batch = Batch(
            obs=obs, task_id=flat_task_id, actions=actions, old_means=old_means,
            old_log_probs=gaussian_log_prob(actions, old_means, self.policy.actor.log_std_of(obs)),
            advantages=advantages.reshape(judged.shape),
            targets=self._in_critic_units(returns.reshape(judged.shape), flat_task_id),
            weights=r.valid.flatten().float()
        )  # fmt: skip
        return batch, explained.view(-1, num_tasks).mean(0)

    def _metrics(self, losses: dict[str, Tensor], explained: Tensor) -> dict[str, float]:
        tensors = dict(losses)
        tensors["Policy/std"] = self.policy.actor.log_std.detach().exp().mean()
        tensors["Train/unstable"] = all_sum((~self.rollout.valid).sum())
        for name, value in zip(self.world.task_names, explained, strict=True):
            tensors[f"Value/explained_variance/{name}"] = value
        return self.episodes.metrics() | as_numbers(tensors)

    def _parts(self) -> Parts:
        shared = {"critic": self.critic, "return_stats": self.return_stats, **self._optimisers()}
        return shared | {"generator": self.generator, "episodes": self.episodes}

    def _check_size(self, state: State) -> None:
        if state["obs"] is not None:
            shapes = tuple(state["obs"].shape), tuple(self.rollout.last_obs.shape)
            self._expect("(num_envs, observations) = ", *shapes)

"""RL²: learning to learn by a memory (Duan et al. 2016, Wang et al. 2016), trained by PPO.

A trial is a few episodes of one task. The policy reads, beside the observation, its last action, the last reward and
whether an episode ended, and keeps its memory from one episode of the trial to the next: what it finds out about the
task in the first it may use in the next. An iteration plays one trial in every row, makes ``epochs`` passes over it in
shuffled mini-batches of chunks, through which gradients flow back, and starts the next trial without memory. The very
first trial only measures what statistics are made of.
``docs/learners/rl2.md`` says what is done otherwise, and why.
"""

import copy
import math
import time
from dataclasses import asdict
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from bidex_algos.experience.advantages import explained_variance, gae, normalise_per_task, task_moments
from bidex_algos.experience.episodes import EpisodeStatistics
from bidex_algos.experience.rollout import check_autoreset
from bidex_algos.gradients.step_size import AdaptiveAdams
from bidex_algos.meta.rl2_agent import RL2Agent
from bidex_algos.meta.rl2_config import PRESETS, RL2Config
from bidex_algos.meta.trials import Batch, Trials, play
from bidex_algos.nets.networks import gaussian_entropy, gaussian_kl, gaussian_log_prob
from bidex_algos.nets.normalise import RunningStats
from bidex_algos.nets.recurrent import RecurrentNet, RecurrentPolicy
from bidex_algos.reports import as_numbers, check_finite
from bidex_meta.errors import BidexError
from bidex_meta.train.distributed import all_sum, broadcast, own_seed, rank, sum_gradients, world_size
from bidex_meta.world.contract import PooledWorld

__all__ = ["PRESETS", "RL2", "RL2Config"]


class RL2(RL2Agent):
    """A policy with a memory that adapts to a task while it plays it, on a batched world.

    It is its own agent: evaluated, it has a memory that is not that of the training.

    In a run of several processes each has a world and samples of its own, and all have the same networks: statistics
    and gradients are those of the samples of all.

    Args:
        world: A world in autoreset mode DISABLED that has what evaluations need, ``max_episode_steps``,
            ``num_slot_tasks`` and ``set_tasks``.
        config: See :class:`RL2Config`.
        seed: Of the initial weights, the sampled actions, the shuffling and the world's first reset.

    Attributes:
        env_steps: Environment steps taken so far, over all rows of all processes; a waiting row takes none.
        per_process: Entries of ``state_dict`` that differ from process to process.
        policy: Network and statistics.

    Raises:
        BidexError: A world that resets by itself, or fewer rows than mini-batches.
    """

    autoreset: ClassVar[str] = "DISABLED"
    """The mode of the world it trains on."""
    adapts: ClassVar[bool] = True
    adapts_by_row: ClassVar[bool] = True
    """Whether its agent is a ``MetaLearningAgent``."""
    per_process: ClassVar[tuple[str, ...]] = ("generator", "episodes")

    def __init__(self, world: Any, config: RL2Config, seed: int):
        _check(world, config)
        self.world, self.config, self.seed = world, config, seed
        self.env_steps = self.trials_played = 0
        d, a = int(world.single_observation_space.shape[0]), int(world.single_action_space.shape[0])
        self.shape = {"observations": d, "actions": a, "num_id_columns": int(getattr(world, "num_id_columns", 0))}

        # Weights come from a CPU generator, so that a seed means the same network on every device.
        init = torch.Generator().manual_seed(seed)
        super().__init__(_make_policy(config, self.shape, init).to(world.device), own_seed(seed))
        self.generator = torch.Generator(self.device).manual_seed(own_seed(seed))
        heads = world.num_tasks if config.value_heads else 1
        self.critic = RecurrentNet(
            self.policy.inputs, config.hidden, config.memory, heads, 0.01, init, config.activation
        ).to(self.device)
        self.adams = AdaptiveAdams(
            self.policy.parameters(),
            self.critic.parameters(),
            learning_rate=config.learning_rate,
            critic_learning_rate=config.critic_learning_rate,
            desired_kl=config.desired_kl if config.adaptive_learning_rate else None,
            bounds=config.learning_rate_range,
            device=self.device,
        )

        limits = world.max_episode_steps.clamp_max(config.max_adapt_steps)
        self.trials = Trials(config.episodes_per_trial, limits, d, a, config.chunk)
        steps = config.episodes_per_trial * float(limits.float().mean()) * world.num_envs * world_size()
        horizon = config.value_horizon * steps / world.num_tasks
        self.return_stats = RunningStats((world.num_tasks,), max_count=horizon).to(self.device)
        self.episodes, self.firsts, self.lasts = (EpisodeStatistics(world.task_id, world.task_names) for _ in range(3))
        # The tasks that the world was made with: of them each trial takes as many as there are rows.
        self.pools = _larger_pools(world)

    def iterate(self) -> dict[str, float]:
        """Plays one trial in every row and learns from it.

        Returns:
            Metrics under TensorBoard-like tags; ``docs/learners/`` explains each.

        Raises:
            FloatingPointError: The loss is no longer finite.
        """
        started = time.perf_counter()
        obs = self._begin()
        counts = [[self.episodes] for _ in range(self.config.episodes_per_trial)]
        counts[0].append(self.firsts)
        counts[-1].append(self.lasts)
        play(self.world, self.policy, self.trials, obs, self.config.blind_share, self.generator, counts)
        collected = time.perf_counter()

        filled = self.trials.filled()
        valid = self.trials.valid & filled
        found = self.trials.obs[filled], self.trials.rewards[valid]
        if self.trials_played == 0:
            # The first trial only measures. Statistics of the starts alone, where nothing moves, made the policy see
            # so much noise that it would have to unlearn most of what it learned from it.
            self.policy.update_statistics(*found)
            losses, explained = {}, self._prepare()[1]
        else:
            batch, explained = self._prepare()
            losses = self._update(batch)
            self.policy.update_statistics(*found)
        steps = int(all_sum(filled.sum()))
        self.env_steps += steps
        self.trials_played += 1
        metrics = self._metrics(losses, explained, filled & ~valid)
        done = time.perf_counter()
        metrics["Perf/collection_time"] = collected - started
        metrics["Perf/learning_time"] = done - collected
        metrics["Perf/steps_per_second"] = steps / (done - started)
        return metrics

    # The trial.

    def _begin(self) -> Tensor:
        """Starts the first episode of a trial; observations (N, d)."""
        if self.pools:
            trial = self.trials_played * world_size() + rank()
            # By turns: all tasks of a class come equally often.
            turned = {name: pool.roll(-trial * rows, 0).numpy() for name, (pool, rows) in self.pools.items()}
            self.world.set_tasks(turned)
        if self.trials_played > 0:
            return self.world.reset()[0]
        # The same seed has given the same weights everywhere, unless a machine computes differently.
        broadcast([*self.policy.parameters(), *self.critic.parameters()])
        obs, _ = self.world.reset(seed=own_seed(self.seed))
        self.policy.observations.update(obs)
        return obs

    # Values. The critic speaks in units of its task's running mean and deviation of returns.

    def _heads(self, out: Tensor, task_id: Tensor) -> Tensor:
        """The critic's outputs (T, B, heads) as one value (T, B) of each row's task (B,)."""
        if not self.config.value_heads:
            return out.squeeze(-1)
        return out.gather(2, task_id.expand(len(out), -1)[..., None]).squeeze(-1)

    def _scale(self) -> tuple[Tensor, Tensor]:
        """Mean and deviation of the returns of each row's task, (N,) each."""
        task_id = self.world.task_id
        return self.return_stats.mean.float()[task_id], self.return_stats.std().float()[task_id]

    @torch.no_grad()
    def _prepare(self) -> tuple[Batch, Tensor]:
        """Turns the trial into a batch; also the explained variance per task (num_tasks,)."""
        t, cfg, task_id, num_tasks = self.trials, self.config, self.world.task_id, self.world.num_tasks
        # The only wait for the device: how many chunks the longest trial fills, its last observation included.
        chunks = int(t.lengths.max()) // cfg.chunk + 1
        slots = chunks * cfg.chunk
        previous = t.previous(slots)
        means, values = [], []
        actor_states, critic_states = [], []
        actor_state = critic_state = self.policy.fresh_memory(self.world.num_envs).state
        for k in range(chunks):
            part = slice(k * cfg.chunk, (k + 1) * cfg.chunk)
            x = self.policy.see(t.obs[part], *(p[part] for p in previous))
            actor_states.append(actor_state)
            critic_states.append(critic_state)
            mean, actor_state = self.policy.actor(x, actor_state)
            value, critic_state = self.critic(x, critic_state)
            means.append(mean)
            values.append(self._heads(value, task_id))
        old_means = torch.cat(means)

        shift, scale = self._scale()
        values = torch.cat(values) * scale + shift
        filled, last = t.filled(slots), t.last(slots)
        valid = t.valid[:slots] & filled
        # What follows the trial's last slot is never asked for.
        next_values = torch.cat([values[1:], values[-1:]])
        # The end of an episode is none of the trial: the next one follows, and the memory with it.
        advantages = gae(
            t.rewards[:slots],
            values,
            next_values,
            terminated=t.terminated[:slots] & last,
            ended=last,
            gamma=t.discounts(slots, cfg.gamma),
            lam=cfg.lam,
            valid=valid,
        )
        returns = advantages + values
        explained = explained_variance(values, returns, task_id, num_tasks, valid)
        self.return_stats.merge(*task_moments(returns, task_id, num_tasks, valid))
        shift, scale = self._scale()
        actions = t.actions[:slots]
        chunk, row = filled[:: cfg.chunk].nonzero(as_tuple=True)
        batch = Batch(
            actions=actions,
            previous=previous,
            old_means=old_means,
            old_log_probs=gaussian_log_prob(actions, old_means, self.policy.log_std),
            advantages=normalise_per_task(advantages, task_id, num_tasks, valid),
            targets=(returns - shift) / scale,
            weights=valid.float(),
            actor_states=torch.stack(actor_states),
            critic_states=torch.stack(critic_states),
            chunk=chunk,
            row=row,
        )
        return batch, explained

    # The update.

    def _update(self, b: Batch) -> dict[str, Tensor]:
        """PPO's update: returns the means over all mini-batches of what it measured."""
        cfg, policy = self.config, self.policy
        old_log_std = policy.log_std.detach().clone()
        low, high = (math.log(std) for std in cfg.std_range)
        chunk_weights = b.weights.view(-1, cfg.chunk, b.weights.shape[1]).sum(1)[b.chunk, b.row]
        measured: list[Tensor] = []
        for epoch in range(cfg.epochs):
            order = torch.randperm(len(b.row), generator=self.generator, device=self.device)
            # The same number of parts in every process, whatever the number of its chunks.
            parts = order.tensor_split(cfg.num_minibatches)
            # Divided by the samples of all processes, losses and gradients become means by being summed over them.
            counts = all_sum(torch.stack([chunk_weights[index].sum() for index in parts])).clamp_min(1.0)
            for number, (index, count) in enumerate(zip(parts, counts, strict=True)):
                measured.append(self._gradients(b, b.chunk[index], b.row[index], count, old_log_std))
                # The first mini-batch compares the sampling policy with itself and says nothing about the step.
                if (epoch, number) != (0, 0):
                    self.adams.follow(measured[-1][2])
                for weights in (policy.parameters(), self.critic.parameters()):
                    nn.utils.clip_grad_norm_(weights, cfg.max_grad_norm)
                self.adams.step()
                with torch.no_grad():
                    policy.log_std.clamp_(low, high)
        names = ["Loss/surrogate", "Loss/value", "Policy/kl", "Policy/clip_fraction"]
        return {**dict(zip(names, torch.stack(measured).mean(0), strict=True)), "Policy/lr": self.adams.rate}

    def _gradients(self, b: Batch, chunk: Tensor, row: Tensor, count: Tensor, old_log_std: Tensor) -> Tensor:
        """Puts the gradients of some chunks, (B,) each, into the parameters.

        ``count`` samples are in the mini-batch, over all processes.

        Returns:
            Surrogate loss, value loss, KL and share of clipped ratios: (4,).
        """
        cfg, policy = self.config, self.policy

        def take(x: Tensor) -> Tensor:
            """The chunks (C, B, ...) of (T, N, ...)."""
            return x[: len(b.weights)].unflatten(0, (-1, cfg.chunk)).transpose(1, 2)[chunk, row].transpose(0, 1)

        x = policy.see(take(self.trials.obs), *(take(p) for p in b.previous))
        mean, _ = policy.actor(x, b.actor_states[chunk, row])
        out, _ = self.critic(x, b.critic_states[chunk, row])
        values = self._heads(out, self.world.task_id[row])
        weight, advantages = take(b.weights) / count, take(b.advantages)

        ratio = torch.exp(gaussian_log_prob(take(b.actions), mean, policy.log_std) - take(b.old_log_probs))
        clipped = ratio.clamp(1.0 - cfg.clip, 1.0 + cfg.clip)
        surrogate = -(weight * torch.minimum(ratio * advantages, clipped * advantages)).sum()
        value_loss = (weight * (values - take(b.targets)).square()).sum()
        entropy = (weight * gaussian_entropy(policy.log_std)).sum()
        with torch.no_grad():
            kl = (weight * gaussian_kl(take(b.old_means), old_log_std, mean, policy.log_std)).sum()
            outside = (weight * ((ratio - 1.0).abs() > cfg.clip)).sum()
        self.adams.zero_grad()
        (surrogate + value_loss - cfg.entropy_weight * entropy).backward()
        numbers = torch.stack([surrogate.detach(), value_loss.detach(), kl, outside])
        return sum_gradients([*policy.parameters(), *self.critic.parameters()], numbers)

    def _metrics(self, losses: dict[str, Tensor], explained: Tensor, broken: Tensor) -> dict[str, float]:
        tensors = dict(losses)
        tensors["Policy/std"] = self.policy.log_std.detach().exp().mean()
        tensors["Train/unstable"] = all_sum(broken.sum())
        for name, value in zip(self.world.task_names, explained, strict=True):
            tensors[f"Value/explained_variance/{name}"] = value
        metrics = self.episodes.metrics() | as_numbers(tensors)
        for which, statistics in (("first", self.firsts), ("last", self.lasts)):
            found = statistics.metrics()
            if found:
                metrics[f"Train/return_{which}_episode"] = found["Train/mean_return"]
                metrics[f"Train/success_{which}_episode"] = found["Train/success_rate"]
        check_finite(metrics, losses, "rl2", self.env_steps, "lower learning_rate")
        return metrics

    # Checkpoints.

    def policy_state_dict(self) -> dict[str, Any]:
        """What :meth:`load_policy` needs: network, statistics, sizes and config."""
        return {"config": asdict(self.config), "shape": dict(self.shape), "weights": self.policy.state_dict()}

    @staticmethod
    def load_policy(state: dict[str, Any], device: str | torch.device = "cpu") -> RL2Agent:
        """The agent of a checkpoint, for a world of any number of rows.

        Args:
            state: ``checkpoint["learner"]["policy"]``.
            device: Where to run it.
        """
        policy = _make_policy(RL2Config(**state["config"]), state["shape"], torch.Generator().manual_seed(0))
        policy.load_state_dict(state["weights"])
        return RL2Agent(policy.to(device))

    def state_dict(self) -> dict[str, Any]:
        """A copy of everything but the world, as tensors and plain values (``torch.load(weights_only=True)``)."""
        return copy.deepcopy(
            {
                "policy": self.policy_state_dict(),
                "critic": self.critic.state_dict(),
                "return_stats": self.return_stats.state_dict(),
                **self.adams.state_dict(),
                "generator": self.generator.get_state(),
                "episodes": [statistics.state_dict() for statistics in (self.episodes, self.firsts, self.lasts)],
                "trials_played": self.trials_played,
                "env_steps": self.env_steps,
            }
        )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave.

        Raises:
            BidexError: The checkpoint comes from a world of another size.
        """
        if state["policy"]["shape"] != self.shape:
            raise BidexError(
                f"rl2: the checkpoint's world had {state['policy']['shape']}, this one has {self.shape}. Resume with "
                "the run's own suite."
            )
        self.policy.load_state_dict(state["policy"]["weights"])
        self.critic.load_state_dict(state["critic"])
        self.return_stats.load_state_dict(state["return_stats"])
        self.adams.load_state_dict(state)
        self.generator.set_state(state["generator"].cpu())
        for statistics, saved in zip((self.episodes, self.firsts, self.lasts), state["episodes"], strict=True):
            statistics.load_state_dict(saved)
        self.trials_played, self.env_steps = int(state["trials_played"]), int(state["env_steps"])


def _check(world: Any, config: RL2Config) -> None:
    check_autoreset(world, "rl2", "DISABLED")
    if world.num_envs < config.num_minibatches:
        raise BidexError(
            f"rl2: {config.num_minibatches} mini-batches need as many rows, got {world.num_envs}. Raise num_envs or "
            "lower num_minibatches."
        )


def _larger_pools(world: PooledWorld) -> dict[str, tuple[Tensor, int]]:
    """Pool of tasks (n, ...) and number of rows of each class that has fewer rows than tasks."""
    pools = {}
    for i, (name, pool) in enumerate(zip(world.task_names, world.pools, strict=True)):
        rows = int((world.task_id == i).sum())
        if rows < len(pool):
            pools[name] = (torch.tensor(pool), rows)
    return pools


def _make_policy(config: RL2Config, shape: dict[str, int], init: torch.Generator) -> RecurrentPolicy:
    return RecurrentPolicy(
        shape["observations"],
        shape["num_id_columns"],
        shape["actions"],
        config.hidden,
        config.memory,
        config.init_std,
        config.reward_unit,
        config.normalise_observations,
        init,
        config.activation,
    )

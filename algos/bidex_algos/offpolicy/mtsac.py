"""MT-SAC: soft actor-critic (Haarnoja et al. 2018) on all tasks of a world at once, with a temperature for each.

For each vector step of the world::

    a = tanh(u), u ~ N(mean, std)(s)             one step in every row; into the replay
    y = r + gamma (1 - terminated) (min_i Q'_i(s', a') - alpha_k log pi(a'|s'))
    Q_i  towards y                               i = 1, 2; on equally many transitions of each task k
    pi   down on alpha_k log pi(a|s) - min_i Q_i(s, a)
    log alpha_k  down on -log alpha_k (log pi(a|s) + H)      the mean over task k alone
    Q'_i  a small step towards Q_i

The target entropy H is ``target_entropy_per_action`` times the number of actions: Haarnoja's -dim(A) by default. One
temperature for all would be set by their mean entropy: a task that is solved and one that still explores need
different ones ("disentangled alphas"). The loss of log alpha is linear in log alpha rather than in alpha, so that its
gradient is the gap in entropy whatever alpha is. Deviations stand in ``docs/learners/mtsac.md``.
"""

import copy
import math
import sys
import time
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor, nn

from bidex_algos.experience.advantages import task_moments
from bidex_algos.experience.episodes import EpisodeStatistics
from bidex_algos.experience.replay import Replay, Transitions, replay_bytes, steps_within
from bidex_algos.experience.rollout import VectorWorld, check_autoreset
from bidex_algos.nets.networks import MLP
from bidex_algos.nets.normalise import ObservationNormaliser, RunningStats
from bidex_algos.nets.precision import autocast, use_bfloat16
from bidex_algos.nets.squashed import SquashedActor, SquashedPolicy
from bidex_algos.offpolicy.mtsac_config import PRESETS, MTSACConfig
from bidex_algos.reports import as_numbers, check_finite
from bidex_meta.errors import BidexError
from bidex_meta.train.distributed import all_sum, broadcast, is_main, own_seed, sum_gradients, world_size

__all__ = ["MTSAC", "PRESETS", "MTSACConfig", "TwinCritic"]


class TwinCritic(nn.Module):
    """Two networks of observation and action, alike but for their initial weights.

    Args:
        inputs: Width of observation and action together.
        heads: Outputs of each network: one per task, or 1 for all.
        config: Layers.
        generator: CPU generator of the initial weights.
    """

    def __init__(self, inputs: int, heads: int, config: MTSACConfig, generator: torch.Generator):
        super().__init__()
        self.heads = heads
        self.nets = nn.ModuleList(
            MLP(inputs, config.hidden, heads, 1.0, generator, config.activation, config.critic_layer_norm)
            for _ in range(2)
        )

    def forward(self, obs: Tensor, actions: Tensor, task_id: Tensor) -> Tensor:
        """Both values of each action: normalised observations (B, d), actions (B, a), tasks (B,) to (2, B)."""
        x = torch.cat([obs, actions], dim=1)
        both = torch.stack([net(x) for net in self.nets])
        return both.gather(2, task_id.expand(2, -1)[..., None]).squeeze(2) if self.heads > 1 else both.squeeze(2)


class MTSAC:
    """Multi-task SAC on a batched world.

    In a run of several processes each has a world and a replay of its own, and all have the same networks: statistics
    and gradients are those of the draws of all, so that an update is of as many times more transitions.

    Args:
        world: A world that resets finished rows within the step.
        config: See :class:`MTSACConfig`.
        seed: Of the initial weights, the sampled actions, the draws and the world's first reset.

    Attributes:
        env_steps: Environment steps taken so far, over all rows of all processes.
        per_process: Entries of ``state_dict`` that differ from process to process.
        policy: The agent that evaluation uses: squashed mean.
        batch_per_task: Transitions of each task in an update.

    Raises:
        BidexError: A task without rows, heads without a one-hot, or no room for a replay.
    """

    per_process = ("generator", "episodes", "replay", "discounted")

    def __init__(self, world: VectorWorld, config: MTSACConfig, seed: int):
        check_autoreset(world, "mtsac", "SAME_STEP")
        self.world, self.config, self.seed = world, config, seed
        self.device = torch.device(world.device)
        self.low_precision = use_bfloat16(config.autocast, self.device)
        self.env_steps = 0
        d, a = int(world.single_observation_space.shape[0]), int(world.single_action_space.shape[0])
        num_id_columns = int(getattr(world, "num_id_columns", 0))
        if config.policy_heads and num_id_columns != world.num_tasks:
            raise BidexError(
                f"mtsac: policy_heads needs the one-hot of {world.num_tasks} tasks at the end of the observation, this "
                f"world shows {num_id_columns} such entries. Switch policy_heads off."
            )

        # Weights come from a CPU generator, so that a seed means the same network on every device.
        init = torch.Generator().manual_seed(seed)
        self.generator = torch.Generator(self.device).manual_seed(own_seed(seed))
        self.shape = {"observations": d, "actions": a, "num_id_columns": num_id_columns}
        self.policy = _make_policy(config, self.shape, init, self.device)
        self.critic = TwinCritic(d + a, world.num_tasks if config.value_heads else 1, config, init).to(self.device)
        self.target_critic = copy.deepcopy(self.critic)
        self.log_alpha = nn.Parameter(torch.full((world.num_tasks,), math.log(config.init_alpha), device=self.device))
        self.target_entropy = config.target_entropy_per_action * a

        def adam(parameters: Any, rate: float) -> torch.optim.Adam:
            return torch.optim.Adam(parameters, lr=rate, eps=config.adam_eps, fused=True)

        self.adams = {
            "actor": adam(self.policy.actor.parameters(), config.learning_rate),
            "critic": adam(self.critic.parameters(), config.critic_learning_rate),
            "alpha": adam([self.log_alpha], config.alpha_learning_rate),
        }

        self.replay = _make_replay(world, config, d, a)
        self.batch_per_task = config.batch_per_task or math.ceil(config.batch_size / world.num_tasks)
        self.task_of_draw = torch.arange(world.num_tasks, device=self.device).repeat_interleave(self.batch_per_task)
        # Rewards that have left the replay fade from the statistics too.
        horizon = self.replay.steps * world.num_envs * world_size() / world.num_tasks
        self.return_stats = RunningStats((world.num_tasks,), max_count=horizon).to(self.device)
        self.discounted = torch.zeros(world.num_envs, device=self.device)
        self.episodes = EpisodeStatistics(world.task_id, world.task_names)

    def iterate(self) -> dict[str, float]:
        """Some vector steps, each followed by its updates.

        Returns:
            Metrics under TensorBoard-like tags; ``docs/learners/`` explains each.

        Raises:
            FloatingPointError: The loss is no longer finite.
        """
        started, learning = time.perf_counter(), 0.0
        if self.replay.added == 0:
            # The same seed has given the same weights everywhere, unless a machine computes differently.
            broadcast([*self.policy.parameters(), *self.critic.parameters(), *self.target_critic.parameters()])
            obs, _ = self.world.reset(seed=own_seed(self.seed))
            self.replay.begin(obs)
            self.policy.observations.update(obs)
        unstable = torch.zeros((), dtype=torch.int64, device=self.device)
        measured: list[Tensor] = []
        for _ in range(self.config.steps_per_iteration):
            unstable += self._step()
            if self.replay.added >= self.config.warmup_steps:
                stepped = time.perf_counter()
                measured += self._learn()
                learning += time.perf_counter() - stepped
        steps = self.config.steps_per_iteration * self.world.num_envs * world_size()
        self.env_steps += steps
        metrics = self._metrics(measured, unstable)
        whole = time.perf_counter() - started
        metrics["Perf/collection_time"] = whole - learning
        metrics["Perf/learning_time"] = learning
        metrics["Perf/steps_per_second"] = steps / whole
        return metrics

    def eval_action(self, obs: Tensor) -> Tensor:
        """Squashed mean for raw observations (N, d): (N, a) in [-1, 1]. N need not be the training world's."""
        return self.policy.eval_action(obs)

    def reset(self, env_mask: Tensor) -> None:
        """Nothing to forget between episodes."""

    # Experience.

    @torch.no_grad()
    def _step(self) -> Tensor:
        """One step in every row; returns how many broke physics."""
        actions = self._act(self.replay.obs)
        obs, reward, terminated, truncated, info = self.world.step(actions)
        self.replay.add(actions, reward, terminated, truncated, obs, info)
        broken = info["unstable"] if "unstable" in info else torch.zeros_like(terminated)
        self._note_returns(reward, terminated | truncated | broken, ~broken)
        self.policy.observations.update(obs)
        self.episodes.update(info)
        return broken.sum()

    def _act(self, obs: Tensor) -> Tensor:
        if self.replay.added < self.config.warmup_steps:
            shape = (len(obs), self.shape["actions"])
            return torch.rand(shape, generator=self.generator, device=self.device) * 2.0 - 1.0
        return self.policy.sample(self.policy.observations(obs), self.generator)[0]

    def _note_returns(self, reward: Tensor, ended: Tensor, valid: Tensor) -> None:
        """Follows the discounted sum of rewards since each episode began."""
        self.discounted = self.config.gamma * self.discounted + reward
        moments = task_moments(self.discounted[None], self.world.task_id, self.world.num_tasks, valid[None])
        self.return_stats.merge(*moments)
        self.discounted = self.discounted.masked_fill(ended, 0.0)

    def _reward_scale(self) -> Tensor:
        """What rewards of each task are divided by (num_tasks,)."""
        if not self.config.per_task_rewards:
            return torch.ones_like(self.log_alpha)
        # Where all returns are about the same, their deviation alone would blow them up.
        return (self.return_stats.std().square() + (0.1 * self.return_stats.mean).square()).sqrt().float()

    # Learning.

    def _learn(self) -> list[Tensor]:
        """The updates that follow one vector step; what each measured."""
        updates, tasks = self.config.updates_per_step, self.world.num_tasks
        places = self.replay.draw(updates, self.batch_per_task, self.generator)
        weights = self.replay.weights(places)
        # Divided by the draws of all processes, losses and gradients become means by being summed over them.
        counts = all_sum(weights.view(updates, tasks, -1).sum(2))
        return [self._update(self.replay.take(places[i]), weights[i], counts[i]) for i in range(updates)]

    def _update(self, draw: Transitions, weights: Tensor, counts: Tensor) -> Tensor:
        """One update of critics, actor, temperatures and target critics.

        Args:
            draw: Transitions, task after task (B).
            weights: 0 for those that teach nothing (B,).
            counts: Sum of the weights of each task over all processes (num_tasks,).

        Returns:
            Losses, entropy, share without weight and value per task (4 + num_tasks,).
        """
        task_id = self.task_of_draw
        obs, next_obs = self.policy.observations(draw.obs), self.policy.observations(draw.next_obs)
        weight = weights / counts.sum().clamp_min(1.0)

        target = self._target(draw, next_obs)
        values = self._values(self.critic, obs, draw.actions)
        critic_loss = (weight * (values - target).square()).sum()
        critic_weights = list(self.critic.parameters())
        self.adams["critic"].zero_grad()
        critic_loss.backward()
        value = self._per_task(weights * values[0].detach()) / counts.clamp_min(1.0)
        weightless = (1.0 - weights).mean() / world_size()
        numbers = sum_gradients(critic_weights, torch.stack([critic_loss.detach(), weightless, *value]))
        nn.utils.clip_grad_norm_(critic_weights, self.config.max_grad_norm)
        self.adams["critic"].step()

        actions, log_prob = self.policy.sample(obs, self.generator)
        alpha = self.log_alpha.detach().exp()[task_id]
        actor_loss = (weight * (alpha * log_prob - self._values(self.critic, obs, actions).amin(0))).sum()
        gap = self._per_task(weights * (log_prob.detach() + self.target_entropy)) / counts.clamp_min(1.0)
        alpha_loss = -(self.log_alpha * gap).sum()
        actor_weights = list(self.policy.actor.parameters())
        self.adams["actor"].zero_grad()
        self.adams["alpha"].zero_grad()
        # With named inputs, no gradient of the critics' weights is computed.
        (actor_loss + alpha_loss).backward(inputs=[*actor_weights, self.log_alpha])
        entropy = -(weight * log_prob.detach()).sum()
        more = sum_gradients([*actor_weights, self.log_alpha], torch.stack([actor_loss.detach(), entropy]))
        nn.utils.clip_grad_norm_(actor_weights, self.config.max_grad_norm)
        self.adams["actor"].step()
        self.adams["alpha"].step()

        with torch.no_grad():
            for behind, ahead in zip(self.target_critic.parameters(), critic_weights, strict=True):
                behind.lerp_(ahead, self.config.tau)
        return torch.cat([numbers[:1], more, numbers[1:]])

    @torch.no_grad()
    def _target(self, draw: Transitions, next_obs: Tensor) -> Tensor:
        """What the critics shall say of the drawn transitions (B,); ``next_obs`` are normalised."""
        task_id = self.task_of_draw
        next_actions, log_prob = self.policy.sample(next_obs, self.generator)
        following = self._values(self.target_critic, next_obs, next_actions).amin(0)
        following = following - self.log_alpha.exp()[task_id] * log_prob
        rewards = draw.rewards / self._reward_scale()[task_id]
        return rewards + self.config.gamma * following.masked_fill(draw.terminated, 0.0)

    def _values(self, critic: TwinCritic, obs: Tensor, actions: Tensor) -> Tensor:
        """Both critics' values of a draw (2, B), in scaled units of reward."""
        with autocast(self.device, self.low_precision):
            return critic(obs, actions, self.task_of_draw)

    def _per_task(self, x: Tensor) -> Tensor:
        """Sums (num_tasks,) of what a draw holds (B,)."""
        return x.view(self.world.num_tasks, -1).sum(1)

    def _metrics(self, measured: list[Tensor], unstable: Tensor) -> dict[str, float]:
        names = self.world.task_names
        tensors: dict[str, Tensor] = {"Train/unstable": all_sum(unstable)}
        if measured:
            tags = ["Loss/critic", "Loss/actor", "Policy/entropy", "Train/weightless"]
            tags += [f"Value/q/{name}" for name in names]
            tensors |= dict(zip(tags, torch.stack(measured).mean(0), strict=True))
        for name, alpha in zip(names, self.log_alpha.detach().exp(), strict=True):
            tensors[f"Policy/alpha/{name}"] = alpha
        metrics = self.episodes.metrics() | as_numbers(tensors)
        losses = ("Loss/critic", "Loss/actor")
        check_finite(metrics, losses, "mtsac", self.env_steps, "lower critic_learning_rate")
        return metrics

    # Checkpoints.

    def policy_state_dict(self) -> dict[str, Any]:
        """What :meth:`load_policy` needs: network, observation statistics, sizes and config."""
        return {"config": asdict(self.config), "shape": dict(self.shape), "weights": self.policy.state_dict()}

    @staticmethod
    def load_policy(state: dict[str, Any], device: str | torch.device = "cpu") -> SquashedPolicy:
        """The agent of a checkpoint, for a world of any number of rows.

        Args:
            state: ``checkpoint["learner"]["policy"]``.
            device: Where to run it.
        """
        init = torch.Generator().manual_seed(0)
        policy = _make_policy(MTSACConfig(**state["config"]), state["shape"], init, torch.device(device))
        policy.load_state_dict(state["weights"])
        return policy

    def state_dict(self) -> dict[str, Any]:
        """A copy of everything but the world, as tensors and plain values (``torch.load(weights_only=True)``)."""
        state = {
            "policy": self.policy_state_dict(),
            "critic": self.critic.state_dict(),
            "target_critic": self.target_critic.state_dict(),
            "log_alpha": self.log_alpha.detach(),
            "adams": {name: adam.state_dict() for name, adam in self.adams.items()},
            "return_stats": self.return_stats.state_dict(),
            "discounted": self.discounted,
            "generator": self.generator.get_state(),
            "episodes": self.episodes.state_dict(),
            "env_steps": self.env_steps,
        }
        # The replay makes its own copy: two of it at once may not fit.
        return copy.deepcopy(state) | {"replay": self.replay.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave.

        Raises:
            BidexError: The checkpoint comes from a world or a replay of another size.
        """
        self.replay.load_state_dict(state["replay"])
        self.policy.load_state_dict(state["policy"]["weights"])
        self.critic.load_state_dict(state["critic"])
        self.target_critic.load_state_dict(state["target_critic"])
        with torch.no_grad():
            self.log_alpha.copy_(state["log_alpha"])
        for name, adam in self.adams.items():
            adam.load_state_dict(state["adams"][name])
        self.return_stats.load_state_dict(state["return_stats"])
        self.discounted = state["discounted"].to(self.device, copy=True)
        self.generator.set_state(state["generator"].cpu())
        self.episodes.load_state_dict(state["episodes"])
        self.env_steps = int(state["env_steps"])


def _make_policy(
    config: MTSACConfig, shape: dict[str, int], init: torch.Generator, device: torch.device
) -> SquashedPolicy:
    d, num_id_columns = shape["observations"], shape["num_id_columns"]
    observations = ObservationNormaliser(d, num_id_columns, config.normalise_observations)
    heads = num_id_columns if config.policy_heads else 1
    actor = SquashedActor(
        d, config.hidden, shape["actions"], heads, config.init_std, config.std_range, init, config.activation
    )
    return SquashedPolicy(observations, actor, use_bfloat16(config.autocast, device)).to(device)


def _make_replay(world: VectorWorld, config: MTSACConfig, observations: int, actions: int) -> Replay:
    """The replay that was asked for, or as much of it as its memory holds.

    Raises:
        BidexError: A task has no rows, or not one vector step fits.
    """
    rows, asked, share = world.num_envs, config.replay_steps, config.cut_share
    present = torch.bincount(world.task_id, minlength=world.num_tasks).tolist()
    if 0 in present:
        raise BidexError(f"mtsac: task {world.task_names[present.index(0)]} has no rows. Raise num_envs.")
    steps = steps_within(config.replay_memory * 1e9, asked, rows, observations, actions, share)
    needed = replay_bytes(asked, rows, observations, actions, share) / 1e9
    if steps == 0:
        raise BidexError(
            f"mtsac: replay_memory {config.replay_memory:g} GB holds not one step of {rows} rows. Raise it."
        )
    if steps < asked and is_main():
        print(
            f"mtsac: a replay of {asked:,} vector steps ({asked * rows:,} transitions) needs {needed:.1f} GB; "
            f"replay_memory is {config.replay_memory:g} GB: it keeps {steps:,} ({steps * rows:,} transitions).",
            file=sys.stderr,
            flush=True,
        )
    return Replay(steps, world.task_id, world.num_tasks, observations, actions, world.device, share)

"""The base of the off-policy learners: a replay per task, updates after each step, critics, targets, checkpoints.

The learners differ in exploration, in the critics' targets and in the actor's update. In an iteration, every
environment takes several steps. After each of these steps, ``updates_per_step`` updates follow, each on the same number
of transitions of each task. Rewards are divided by the running standard deviation of their task's discounted return, so
that no task dominates another.
"""

import copy
import math
from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from typing import ClassVar

import torch
from torch import Tensor, nn

from bidex_algos.advantages import discounts, task_moments
from bidex_algos.learner import Learner, as_numbers
from bidex_algos.nets.architecture import Critics, NetworkConfig, network_bytes
from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import Autocast, autocast, use_bfloat16
from bidex_algos.nets.normalise import RunningStats
from bidex_algos.replay import Stretches, Transitions, replay_within
from bidex_algos.rollout import EpisodeStatistics
from bidex_meta.training.distributed import all_sum, sum_gradients, world_size
from bidex_meta.training.learner import Capability, Parts, State
from bidex_meta.utils.validation import BelowOne, Count, NonNegative, Positive, Share, Whole
from bidex_meta.world.contract import Info, VectorWorld


@dataclass(frozen=True)
class OffPolicyConfig(NetworkConfig):
    """Options of networks, replay, updates, statistics; a vector step is one step in every environment of the world."""

    value_heads: bool = True  # Give each critic one output per task instead of one output for all tasks.
    critic_layer_norm: bool = True
    """Apply layer norm in the critics. It keeps values from diverging with many updates per step."""
    replay_steps: Count = 500  # Vector steps that the replay keeps, if replay_memory allows.
    replay_memory: Positive = 2.0  # Upper bound of the memory for the replay of each process, in GB (10^9 bytes).
    cut_share: Share = 0.0625
    """Space in the replay for last observations before time limits, as a share of all transitions. The space is too
    small if episodes are shorter than 1 / cut_share steps; Train/weightless then rises."""
    warmup_steps: Whole = 20  # Vector steps of uniform actions before the first update.
    steps_per_iteration: Count = 8  # Vector steps between two reports.
    updates_per_step: Count = 4  # Updates of all networks after each vector step.
    batch_size: Count = 1024  # Transitions per update, split evenly over the tasks.
    batch_per_task: Count | None = None  # Transitions of each task per update; replaces batch_size.
    gamma: BelowOne = 0.93  # Discount per step.
    n_steps: Count = 1  # Number of steps whose rewards a target sums before it adds the value of the next state.
    tau: Share = 0.02  # Share of the critics that enters the target critics in each update (1 - Polyak's factor).
    learning_rate: Positive = 3e-4  # Adam's step size for the actor.
    critic_learning_rate: Positive = 1e-3  # Adam's step size for the critics.
    weight_decay: NonNegative = 0.0  # Weight decay of AdamW, relative to the step size; 0: Adam.
    adam_eps: NonNegative = 1e-8  # Constant that Adam adds to its denominators.
    max_grad_norm: Positive = 1.0  # Gradients are clipped to this norm, separately for actor and critics.
    normalise_observations: bool = True
    """Give observations zero mean and unit variance by running statistics; the task's one-hot is not changed."""
    per_task_rewards: bool = True
    """Divide drawn rewards by the running standard deviation of their task's discounted return."""
    autocast: Autocast = "auto"  # Use bfloat16 in hidden layers; auto: on CUDA and on CPUs with AMX or AVX-512's BF16.

    def bytes_held(self, num_envs: int, width: int) -> int:
        """Estimate the memory that the learner takes, in bytes, if it stores ``width`` numbers per environment step."""
        return self.bytes_stored(num_envs, width) + network_bytes(self.hidden, width, 3)

    def bytes_stored(self, num_envs: int, width: int) -> int:
        """Estimate the bytes of the replay, if ``width`` numbers are stored per environment step."""
        return int(min(self.replay_memory * 1e9, 4 * num_envs * width * self.replay_steps))


class ReturnScale:
    """Running statistics, for each task, of the discounted sum of rewards since the start of an episode.

    The statistics of a task cover about its last ``horizon`` sums, because older sums lose weight. ``gamma`` is a
    number, or one number per environment (N,).
    """

    def __init__(self, world: VectorWorld, gamma: float | Tensor, horizon: float):
        self.gamma = gamma
        self.task_id = world.task_id
        self.num_tasks = world.num_tasks
        self.stats = RunningStats((world.num_tasks,), max_count=horizon).to(world.device)
        self.discounted = torch.zeros(world.num_envs, device=world.device)

    def note(self, reward: Tensor, terminated: Tensor, truncated: Tensor, broken: Tensor) -> None:
        """Add one step of all environments: rewards (N,) and end flags, bool (N,); broken steps do not count."""
        self.discounted = self.gamma * self.discounted + reward
        self._take(truncated & ~terminated, ~broken)
        self.discounted = self.discounted.masked_fill(terminated | truncated | broken, 0.0)

    def _take(self, cut: Tensor, valid: Tensor) -> None:
        self.stats.merge(*task_moments(self.discounted[None], self.task_id, self.num_tasks, valid[None]))

    def deviation(self) -> Tensor:
        """Return the standard deviation of each task's returns (num_tasks,).

        The result is at least a tenth of the returns' absolute mean.
        """
        # If all returns are almost equal, dividing by their standard deviation would inflate them.
        return (self.stats.std().square() + (0.1 * self.stats.mean).square()).sqrt().float()

    def parts(self) -> Parts:
        """Return the tensors and statistics that a checkpoint stores, by name."""
        return {"return_stats": self.stats, "discounted": self.discounted}


class OffPolicy(Learner):
    """An actor and critics that learn from a replay; target networks estimate the value of the next state.

    Each process has its own replay and draws ``batch_per_task`` transitions of each task, ordered by task
    (``task_of_draw``). ``gamma_of_rows`` holds the discounts of the environments, and ``gamma_of_draw`` holds the
    discounts of a draw's transitions.
    """

    config: OffPolicyConfig
    capabilities = frozenset({Capability.DISCOUNTS_BY_CLASS})
    per_process = ("generator", "episodes", "replay", "discounted")
    num_critics: ClassVar[int] = 2
    returns_type: ClassVar[type[ReturnScale]] = ReturnScale

    def __init__(self, world: VectorWorld, config: OffPolicyConfig, seed: int):
        super().__init__(world, config, seed)
        self.low_precision = use_bfloat16(config.autocast, self.device)
        judged = self.inputs.extended("action", self.shape.actions)
        self.critic = self._make_critics(judged, world.num_tasks if config.value_heads else 1).to(self.device)
        self.target_critic = copy.deepcopy(self.critic)
        self.adams = {
            "actor": self._adam(self.policy.actor.parameters(), config.learning_rate),
            "critic": self._adam(self.critic.parameters(), config.critic_learning_rate),
        }
        self.replay = replay_within(
            self.name, world, self.shape.observations, self.shape.actions, config.replay_steps, config.replay_memory,
            config.cut_share
        )  # fmt: skip
        self.batch_per_task = config.batch_per_task or math.ceil(config.batch_size / world.num_tasks)
        self.task_of_draw = torch.arange(world.num_tasks, device=self.device).repeat_interleave(self.batch_per_task)
        self.gamma_of_rows = discounts(world, config.gamma, world.task_id)
        self.gamma_of_draw = discounts(world, config.gamma, self.task_of_draw)
        # Rewards that the replay no longer holds also fade from the statistics.
        horizon = self.replay.steps * world.num_envs * world_size() / world.num_tasks
        self.returns = self.returns_type(world, self.gamma_of_rows, horizon)
        self.episodes = EpisodeStatistics(world.task_id, world.task_names)

    def _make_critics(self, inputs: Inputs, heads: int) -> nn.Module:
        layer_norm = self.config.critic_layer_norm
        return Critics(inputs, heads, self.config, layer_norm, self.initial, self.num_critics)

    def _adam(self, parameters: Iterable[nn.Parameter], rate: float, decay: float | None = None) -> torch.optim.Adam:
        if decay is None:
            decay = self.config.weight_decay
        if decay:
            kind = torch.optim.AdamW
        else:
            kind = torch.optim.Adam
        return kind(parameters, lr=rate, eps=self.config.adam_eps, weight_decay=decay, fused=True)

    @abstractmethod
    def _explore(self, obs: Tensor) -> Tensor:
        """Return exploring actions (N, a) in [-1, 1] for raw observations (N, d)."""

    @abstractmethod
    def _update(self, draw: Transitions, weights: Tensor, counts: Tensor) -> dict[str, Tensor]:
        """Update the networks once with the B transitions of a draw; return scalars to be logged.

        ``weights`` (B,) are 0 for transitions that teach nothing, otherwise 1. ``counts`` (num_tasks,) are the sums of
        the weights of each task over all processes.
        """

    def _own_parts(self) -> Parts:
        return {}

    def _reported(self) -> dict[str, Tensor]:
        return {}

    def _iterate(self) -> dict[str, float]:
        unstable = torch.zeros((), dtype=torch.int64, device=self.device)
        measured: list[dict[str, Tensor]] = []
        for _ in range(self.config.steps_per_iteration):
            with self._collecting():
                if self.replay.added == 0:
                    self.replay.begin(self._first_observations())
                unstable += self._step()
            if self.replay.added >= self.config.warmup_steps:
                measured += self._learn()
        self.env_steps += self.config.steps_per_iteration * self.world.num_envs * world_size()
        tensors = {"Train/unstable": all_sum(unstable)}
        if measured:
            names = sorted(measured[0], key=lambda name: name.partition("/")[0])
            means = torch.stack([torch.stack([each[name] for name in names]) for each in measured]).mean(0)
            tensors |= dict(zip(names, means, strict=True))
        return self.episodes.metrics() | as_numbers(tensors | self._reported())

    @torch.no_grad()
    def _step(self) -> Tensor:
        rows = self.world.num_envs
        device = self.device
        if self.replay.added < self.config.warmup_steps:
            actions = torch.rand(rows, self.shape.actions, generator=self.generator, device=device) * 2.0 - 1.0
        else:
            actions = self._explore(self.replay.obs)
        obs, reward, terminated, truncated, info = self.world.step(actions)
        self.replay.add(actions, reward, terminated, truncated, obs, info)
        self.returns.note(reward, terminated, truncated, info["unstable"])
        self.policy.observations.update(obs)
        self.episodes.update(info)
        self._note(reward, info)
        return info["unstable"].sum()

    def _note(self, reward: Tensor, info: Info) -> None:
        """Process rewards (N,) and info of a step, after replay and statistics have been updated.

        Subclasses override this method; here it does nothing.
        """

    def _reward_scale(self) -> Tensor:
        scale = self.returns.deviation()
        if self.config.per_task_rewards:
            return scale
        return torch.ones_like(scale)

    def _learn(self) -> list[dict[str, Tensor]]:
        updates = self.config.updates_per_step
        tasks = self.world.num_tasks
        places = self.replay.draw(updates, self.batch_per_task, self.generator)
        stretches = Stretches(self.replay, places, self.config.n_steps, self.gamma_of_draw)
        weights = self.replay.weights(stretches.last)
        # Losses and gradients are divided by the draws of all processes, so their sum over processes is a mean.
        counts = all_sum(weights.view(updates, tasks, -1).sum(2))
        return [self._update(stretches.take(i), weights[i], counts[i]) for i in range(updates)]

    def _values(self, critic: nn.Module, obs: Tensor, actions: Tensor) -> Tensor:
        with autocast(self.device, self.low_precision):
            return critic(obs, actions, self.task_of_draw)

    def _pooled(self, values: Tensor) -> Tensor:
        return values.amin(0)

    def _bootstrapped(self, draw: Transitions, following: Tensor) -> Tensor:
        """Return targets (B,): scaled reward + gamma^steps * ``following``.

        ``following`` (B,) is the value of the next state; it counts as 0 after a termination.
        """
        rewards = draw.rewards / self._reward_scale()[self.task_of_draw]
        return rewards + self.gamma_of_draw**draw.steps * following.masked_fill(draw.terminated, 0.0)

    def _fit_critics(
        self, obs: Tensor, draw: Transitions, target: Tensor, weights: Tensor, counts: Tensor,
        beside: Tensor | float = 0.0, also: Iterable[nn.Parameter] = ()
    ) -> dict[str, Tensor]:  # fmt: skip
        """Take one gradient step of all critics towards the targets ``target`` (B, ...).

        ``obs`` (B, d) are normalised observations. ``weights`` and ``counts`` are described in :meth:`_update`.
        ``beside`` is another loss, which is added to the critics' loss. ``also`` are further parameters of the critics'
        optimiser, which take a step on the sum of both losses. Returns scalars to be logged.
        """
        losses, values = self._critic_losses(obs, draw.actions, target)
        loss = (weights / counts.sum().clamp_min(1.0) * losses).sum()
        value = self._per_task(weights * values) / counts.clamp_min(1.0)
        numbers = torch.stack([loss.detach(), (1.0 - weights).mean() / world_size(), *value])
        numbers = self._descend(loss + beside, numbers, "critic", critic=[*self.critic.parameters(), *also])
        names = [f"Value/q/{name}" for name in self.world.task_names]
        return dict(zip(["Loss/critic", "Train/weightless", *names], numbers, strict=True))

    def _critic_losses(self, obs: Tensor, actions: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        values = self._values(self.critic, obs, actions)
        return (values - target).square(), values[0].detach()

    def _descend(self, loss: Tensor, numbers: Tensor, clipped: str, **parameters: list[nn.Parameter]) -> Tensor:
        """Take one step of each named optimiser on ``loss``, which is summed over processes.

        ``parameters`` maps the name of each optimiser to its parameters. Only the gradients of the optimiser called
        ``clipped`` are clipped. Returns ``numbers`` (n,), summed over processes.
        """
        weights = list(chain.from_iterable(parameters.values()))
        for name in parameters:
            self.adams[name].zero_grad()
        loss.backward(inputs=weights)
        numbers = sum_gradients(weights, numbers)
        nn.utils.clip_grad_norm_(parameters[clipped], self.config.max_grad_norm)
        for name in parameters:
            self.adams[name].step()
        return numbers

    def _per_task(self, x: Tensor) -> Tensor:
        return x.view(self.world.num_tasks, -1).sum(1)

    def _parts(self) -> Parts:
        networks = {"critic": self.critic, "target_critic": self.target_critic, **self._own_parts()}
        statistics = {**self.returns.parts(), "generator": self.generator, "episodes": self.episodes}
        return {**networks, "adams": self.adams, **statistics}

    def state_dict(self) -> State:
        """Return the base class's state and, in addition, a copy of the replay.

        The replay makes this copy itself. If the base class saved the replay, it would make a second copy, and two
        copies may not fit in memory.
        """
        return super().state_dict() | {"replay": self.replay.state_dict()}

    def load_state_dict(self, state: State) -> None:
        """Restore the result of :meth:`state_dict`; raise BidexError if the world's or replay's size differs."""
        self.replay.load_state_dict(state["replay"])
        super().load_state_dict(state)

"""The base of the offline learners: batches of stored transitions, critics and targets, updates, checkpoints.

The world provides sizes and names and is never stepped; ``env_steps`` counts updates instead of environment steps.
"""

import copy
import math
from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from bidex_algos.advantages import discounts
from bidex_algos.learner import Learner, as_numbers
from bidex_algos.nets.architecture import Critics, NetworkConfig, Options, network_bytes
from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import Autocast, autocast, use_bfloat16
from bidex_algos.replay import Transitions
from bidex_meta.data.joined import Joined
from bidex_meta.errors import BidexError
from bidex_meta.training.learner import NO_SOURCES, Capability, Parts, Sources, State
from bidex_meta.utils.validation import BelowOne, Count, NonNegative, Positive, Share
from bidex_meta.world.contract import VectorWorld


@dataclass(frozen=True)
class OfflineConfig(NetworkConfig):
    """Options of networks, batches and statistics; the defaults are the preset ``laptop``."""

    updates_per_iteration: Count = 1000  # Updates per iteration; --evaluate-every and --video-every count iterations.
    batch_size: Count = 256  # Transitions per update, split evenly over the tasks.
    batch_per_task: Count | None = None  # Transitions of each task per update; replaces batch_size.
    learning_rate: Positive = 3e-4  # Adam's step size for the actor.
    adam_eps: NonNegative = 1e-8  # Constant that Adam adds to its denominators.
    max_grad_norm: Positive | None = None
    """Gradients are clipped to this norm, separately for each network; None: no clipping."""
    normalise_observations: bool = True
    """Give observations zero mean and unit variance by the data's statistics; the task's one-hot is not changed."""
    normalise_per_task: bool = False  # Use separate statistics for each task; the world must show the task's one-hot.
    autocast: Autocast = "auto"  # Use bfloat16 in hidden layers; auto: on CUDA and on CPUs with AMX or AVX-512's BF16.

    def bytes_held(self, num_envs: int, width: int) -> int:
        """Estimate the bytes of the networks; the data are counted when they are read."""
        return network_bytes(self.hidden, width, 4)


@dataclass(frozen=True)
class CriticConfig(OfflineConfig):
    """Additional options of offline learners with critics."""

    value_heads: bool = True  # Give each critic one output per task instead of one output for all tasks.
    critic_layer_norm: bool = True
    """Apply layer norm in the critics. It keeps the values of actions that do not occur in the data from growing."""
    critic_learning_rate: Positive = 3e-4  # Adam's step size for the critics.
    gamma: BelowOne = 0.99  # Discount per step.
    tau: Share = 0.005  # Share of a network that enters its target network in each update (1 - Polyak's factor).
    per_task_rewards: bool = True  # Divide rewards by the standard deviation of their task's discounted returns.


PAPER: Options = {"value_heads": False, "critic_layer_norm": False, "per_task_rewards": False}
"""Options that the preset ``paper`` turns off in learners with critics. Table 46 and the papers do not have them."""


class Batches:
    """Transitions on a device; a batch has ``per_task`` transitions of each of ``num_tasks`` tasks."""

    def __init__(self, data: Joined, num_tasks: int, per_task: int, device: torch.device):
        self._per_task = per_task
        self._device = device
        self._observations = data.observations.to(device)
        self._at = data.at.to(device)
        self._actions = data.actions.to(device)
        self._rewards = data.rewards.to(device)
        self._terminated = data.terminated.to(device)
        self._of_task = torch.argsort(data.task, stable=True).to(device)
        self._count = torch.bincount(data.task, minlength=num_tasks).to(device)
        self._first = self._count.cumsum(0) - self._count
        self.fingerprint = data.fingerprint()

    def draw(self, batches: int, generator: torch.Generator) -> Tensor:
        """Draw indices uniformly within each task: int64 (batches, num_tasks * per_task), ordered by task."""
        shape = (batches, len(self._count), self._per_task)
        # A remainder of this large number favours no transition by more than 1 in 2^40 / transitions.
        drawn = torch.randint(2**40, shape, generator=generator, device=self._device) % self._count[:, None]
        return self._of_task[self._first[:, None] + drawn].flatten(1)

    def take(self, places: Tensor) -> Transitions:
        """Return the transitions at the indices ``places`` (B,)."""
        at = self._at[places]
        return Transitions(
            obs=self._observations.index_select(0, at), actions=self._actions.index_select(0, places),
            rewards=self._rewards[places], next_obs=self._observations.index_select(0, at + 1),
            terminated=self._terminated[places]
        )  # fmt: skip

    def chunks(self) -> tuple[Tensor, ...]:
        """Return all states in chunks, (n, d) each."""
        return self._observations.split(65_536)


def return_deviation(data: Joined, num_tasks: int, gamma: Tensor | float) -> Tensor:
    """Return the standard deviation of each task's discounted returns (num_tasks,), over the returns from all states.

    In an episode that a time limit cut, rewards are summed up to the cut. The result is 1 if all returns are equal.
    ``gamma`` is a number or (num_tasks,). The number of steps that a sum spans is doubled until it spans the longest
    episode.
    """
    returns = data.rewards.double()
    factor = torch.as_tensor(gamma, dtype=torch.float64).cpu().expand(num_tasks)[data.task]
    span = 1
    longest = int(data.left.max()) + 1
    while span < longest:
        inside = data.left[:-span] >= span
        behind = factor[:-span] ** span * returns[span:]
        # The sum is not in place, because the later entries must still have the shorter span.
        returns = torch.cat([returns[:-span] + torch.where(inside, behind, 0.0), returns[-span:]])
        span *= 2
    count = torch.bincount(data.task, minlength=num_tasks)
    mean = torch.zeros(num_tasks, dtype=torch.float64).index_add_(0, data.task, returns) / count
    square = (returns - mean[data.task]).square()
    deviation = (torch.zeros(num_tasks, dtype=torch.float64).index_add_(0, data.task, square) / count).sqrt()
    return torch.where(deviation > 1e-8, deviation, 1.0).float()


class Offline(Learner):
    """Base of the learners that learn from stored data (``Sources.data``).

    ``generator`` draws only transitions, so that learners with the same seed see the same transitions; ``noise`` draws
    everything else. A batch has ``batch_per_task`` transitions of each task, ordered by task (``task_of_draw``).
    """

    capabilities = frozenset({Capability.OFFLINE, Capability.DISCOUNTS_BY_CLASS})
    num_critics: ClassVar[int] = 2
    critic: Critics
    target_critic: Critics

    def __init__(self, world: VectorWorld, config: Any, seed: int, sources: Sources = NO_SOURCES):
        sources.check(self.name, "data", needed="data")
        super().__init__(world, config, seed)
        self.low_precision = use_bfloat16(config.autocast, self.device)
        self.noise = torch.Generator(self.device).manual_seed(seed ^ 0x5EED)
        self.batch_per_task = config.batch_per_task or math.ceil(config.batch_size / world.num_tasks)
        self.task_of_draw = torch.arange(world.num_tasks, device=self.device).repeat_interleave(self.batch_per_task)
        self.adams = {"actor": self._adam(self.policy.actor.parameters(), config.learning_rate)}
        self.reward_scale = torch.ones(world.num_tasks, device=self.device)
        if self.num_critics:
            self.critic = self._make_critics()
            self.target_critic = copy.deepcopy(self.critic)
            self.adams["critic"] = self._adam(self.critic.parameters(), config.critic_learning_rate)
            self.gamma_of_draw = discounts(world, config.gamma, self.task_of_draw)
        assert sources.data is not None
        self._batches = self._read(sources.data)

    def _read(self, data: Joined) -> Batches:
        """Return the transitions as batches; compute the statistics of observations and returns."""
        tasks = self.world.num_tasks
        batches = Batches(data, tasks, self.batch_per_task, self.device)
        for chunk in batches.chunks():
            self.policy.observations.update(chunk)
        if self.num_critics and self.config.per_task_rewards:
            gamma = discounts(self.world, self.config.gamma, torch.arange(tasks, device=self.device))
            self.reward_scale = return_deviation(data, tasks, gamma).to(self.device)
        return batches

    @abstractmethod
    def _update(self, draw: Transitions) -> dict[str, Tensor]:
        """Update all networks once with a batch that is ordered by task; return scalars whose means are logged."""

    def _make_critics(self) -> Critics:
        if self.config.value_heads:
            heads = self.world.num_tasks
        else:
            heads = 1
        judged = self.inputs.extended("action", self.shape.actions)
        return self._critics(judged, heads, self.num_critics)

    def _critics(self, inputs: Inputs, heads: int, count: int) -> Critics:
        layer_norm = self.config.critic_layer_norm
        return Critics(inputs, heads, self.config, layer_norm, self.initial, count).to(self.device)

    def _own_parts(self) -> Parts:
        return {}

    def _iterate(self) -> dict[str, float]:
        sums: dict[str, Tensor] = {}
        counts: dict[str, int] = {}
        for places in self._batches.draw(self.config.updates_per_iteration, self.generator):
            with self._collecting():
                draw = self._batches.take(places)
            self.env_steps += 1
            for name, value in self._update(draw).items():
                sums[name] = sums[name] + value if name in sums else value
                counts[name] = counts.get(name, 0) + 1
        return as_numbers({name: total / counts[name] for name, total in sums.items()})

    def _values(self, critic: nn.Module, obs: Tensor, actions: Tensor) -> Tensor:
        with autocast(self.device, self.low_precision):
            return critic(obs, actions, self.task_of_draw)

    def _bootstrapped(self, draw: Transitions, following: Tensor) -> Tensor:
        rewards = draw.rewards / self.reward_scale[self.task_of_draw]
        return rewards + self.gamma_of_draw * following.masked_fill(draw.terminated, 0.0)

    def _fit_critics(self, obs: Tensor, draw: Transitions, target: Tensor) -> dict[str, Tensor]:
        values = self._values(self.critic, obs, draw.actions)
        loss = (values - target).square().mean(1).sum()
        self._descend(loss, "critic", self.critic)
        of_tasks = values[0].detach().view(self.world.num_tasks, -1).mean(1)
        reported = {f"Value/q/{name}": value for name, value in zip(self.world.task_names, of_tasks, strict=True)}
        return {"Loss/critic": loss.detach()} | reported

    def _descend(self, loss: Tensor, name: str, *modules: nn.Module) -> None:
        weights = list(chain.from_iterable(module.parameters() for module in modules))
        self.adams[name].zero_grad()
        loss.backward(inputs=weights)
        if self.config.max_grad_norm is not None:
            nn.utils.clip_grad_norm_(weights, self.config.max_grad_norm)
        self.adams[name].step()

    def _adam(self, parameters: Iterable[nn.Parameter], rate: float) -> torch.optim.Adam:
        return torch.optim.Adam(parameters, lr=rate, eps=self.config.adam_eps, fused=True)

    def _normal(self, like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=self.noise, device=self.device)

    def _parts(self) -> Parts:
        if self.num_critics:
            critics = {"critic": self.critic, "target_critic": self.target_critic}
        else:
            critics = {}
        rest = {"generator": self.generator, "noise": self.noise, "reward_scale": self.reward_scale}
        return {**critics, **self._own_parts(), "adams": self.adams, **rest}

    def _place(self) -> State:
        return super()._place() | {"data": dict(self._batches.fingerprint)}

    def _check_size(self, state: State) -> None:
        super()._check_size(state)
        here = self._batches.fingerprint
        if here and state["data"] and here != state["data"]:
            differ = next(name for name in here if here[name] != state["data"].get(name))
            raise BidexError(
                f"{self.name}: the checkpoint's data sets have {differ} {state['data'].get(differ):,.6g}, these "
                f"{here[differ]:,.6g} (sums; transitions: their number). Resume with the run's own data sets."
            )

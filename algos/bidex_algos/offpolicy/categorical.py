"""What FastTD3, BRC and FlashSAC share: critics that give a distribution of the return, taught by cross-entropy.

Z(s, a) has probabilities of fixed values ("atoms"); targets r + gamma (1 - terminated) Z'(s', a') are projected back on
them (C51, Bellemare et al. 2017, arXiv 1707.06887). Unlike a regression's, its gradient does not grow with the scale of
a task's returns; but rewards must be scaled into the atoms' range, by the task's largest return (``ReturnBound``).
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from msgspec import Meta
from torch import Tensor, nn

from bidex_algos.nets.architecture import network_bytes, network_of
from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import MLP, Layers, MakeNetwork, autocast
from bidex_algos.offpolicy.base import OffPolicy, OffPolicyConfig, ReturnScale
from bidex_algos.replay import Transitions
from bidex_meta.errors import BidexError
from bidex_meta.training.distributed import all_max
from bidex_meta.training.learner import Parts
from bidex_meta.utils.validation import MOST, Positive
from bidex_meta.world.contract import VectorWorld


class Atoms(nn.Module):
    """``count`` values (A >= 2), evenly spaced, that a distribution gives probabilities to; it has no weights."""

    def __init__(self, low: float, high: float, count: int):
        super().__init__()
        self.low, self.high, self.count = low, high, count
        self.values: Tensor
        self.register_buffer("values", torch.linspace(low, high, count), persistent=False)

    def mean(self, probs: Tensor) -> Tensor:
        """Expected values (...) of distributions (..., A)."""
        return (probs * self.values).sum(-1)

    def projected(self, probs: Tensor, shift: Tensor, factor: Tensor) -> Tensor:
        """The distribution (B, A) of shift + factor * Z on the atoms, where Z is distributed as ``probs`` (B, A).

        What falls between two atoms is split between them so that its mean stays; what falls beyond the range goes to
        the atom at its end. ``shift`` and ``factor`` are (B,).
        """
        moved = shift[:, None] + factor[:, None] * self.values
        # In units of the distance of two atoms, from the lowest.
        place = (moved.clamp(self.low, self.high) - self.low) * ((self.count - 1) / (self.high - self.low))
        share = place - place.floor()
        # What is not a number shall stay so and not become a place in memory.
        index = place.long().clamp(0, self.count - 1)
        out = torch.zeros_like(probs).scatter_add_(1, index, probs * (1.0 - share))
        return out.scatter_add_(1, (index + 1).clamp_max(self.count - 1), probs * share)


@dataclass(frozen=True)
class CategoricalConfig(OffPolicyConfig):
    """The critics' distributions and layers, beside what all off-policy learners have."""

    critic_hidden: Layers = (256, 256)  # Widths of the critics' hidden layers; ``hidden`` is then the actor's alone.
    atoms: Annotated[int, Meta(ge=2, le=MOST)] = 101  # Values that a distribution of the return gives probabilities to.
    value_bound: Positive = 10.0  # They lie evenly from minus this to this, in scaled rewards.
    clipped_double_q: bool = True  # Targets and actor take the critic that says less; off: the mean of both.

    def bytes_held(self, num_envs: int, width: int) -> int:
        """As in the base, where ``hidden`` is of all networks, and the critics'."""
        return super().bytes_held(num_envs, width) + network_bytes((*self.critic_hidden, self.atoms), width, 2)


def check_residual(config: CategoricalConfig) -> None:
    """Raises BidexError where residual networks cannot be made of a config's layers."""
    if not config.shares_a_trunk:
        raise BidexError(f"{config.algo}: its networks are residual; architecture must be shared or multi_head.")
    for name, widths in (("hidden", config.hidden), ("critic_hidden", config.critic_hidden)):
        if len(set(widths)) != 1:
            raise BidexError(f"{config.algo}: {name} must be one width, once or more often, got {widths}.")


class CategoricalCritics(nn.Module):
    """Networks of observation and action that give distributions; arguments as those of ``Critics``."""

    def __init__(
        self, inputs: int | Inputs, heads: int, config: CategoricalConfig, generator: torch.Generator, count: int,
        network: MakeNetwork
    ):  # fmt: skip
        super().__init__()
        self.heads = heads
        self.atoms = Atoms(-config.value_bound, config.value_bound, config.atoms)
        outputs, norm = heads * config.atoms, config.critic_layer_norm
        given = inputs, config.critic_hidden, outputs, 0.01, generator, config.activation, norm
        nets = [network(*given) for _ in range(count)]
        # At first the mean is 0, the deviation a tenth of the bound: from an even distribution, which is much wider,
        # means move slowly, since a cross-entropy pulls at them with its inverse variance.
        place = self.atoms.values / (0.1 * config.value_bound)
        with torch.no_grad():
            for net in nets:
                net.output_bias.view(heads, -1).copy_(-0.5 * place.square())
        self.nets = nn.ModuleList(nets)

    def log_probs(self, obs: Tensor, actions: Tensor, task_id: Tensor) -> Tensor:
        """Of each atom: normalised observations (B, d), actions (B, a), tasks (B,) to (count, B, atoms)."""
        x = torch.cat([obs, actions], dim=1)
        logits = torch.stack([net(x) for net in self.nets])
        if self.heads > 1:
            head = task_id.view(1, -1, 1, 1).expand(len(logits), -1, 1, self.atoms.count)
            logits = logits.unflatten(2, (self.heads, -1)).gather(2, head).squeeze(2)
        return torch.log_softmax(logits, dim=2)

    def forward(self, obs: Tensor, actions: Tensor, task_id: Tensor) -> Tensor:
        """Expected values (count, B); arguments as for :meth:`log_probs`."""
        return self.atoms.mean(self.log_probs(obs, actions, task_id).exp())


RECENT = 0.9  # weight of a reward in the recent ones' mean over that of the next: about the last ten steps count


class ReturnBound(ReturnScale):
    """Beside the statistics the largest return of each task, without its sign: what a fixed range of values must hold.

    The sum is discounted towards the episode's beginning, since its end is not known; both weigh any stretch of rewards
    alike. At a time limit the episode is taken to go on as it went, or as it went most recently if that is more.
    ``mass`` is the sum (N,), had all rewards been 1, ``recent`` both with a discount of at most :data:`RECENT` (2, N).
    """

    def __init__(self, world: VectorWorld, gamma: float | Tensor, horizon: float):
        super().__init__(world, gamma, horizon)
        self.bound = torch.zeros(world.num_tasks, device=world.device)
        self.mass = torch.zeros(world.num_envs, device=world.device)
        self.recent = torch.zeros(2, world.num_envs, device=world.device)
        self.short = torch.as_tensor(gamma, device=world.device).clamp_max(RECENT)

    def note(self, reward: Tensor, terminated: Tensor, truncated: Tensor, broken: Tensor) -> None:
        """As in the base."""
        self.mass = self.gamma * self.mass + 1.0
        self.recent = self.short * self.recent + torch.stack([reward, torch.ones_like(reward)])
        super().note(reward, terminated, truncated, broken)
        over = terminated | truncated | broken
        self.mass, self.recent = self.mass.masked_fill(over, 0.0), self.recent.masked_fill(over, 0.0)

    def _take(self, cut: Tensor, valid: Tensor) -> None:
        super()._take(cut, valid)
        size, (rewards, mass), rest = self.discounted.abs(), self.recent, 1.0 - self.gamma
        size = torch.where(cut, torch.maximum(size / (rest * self.mass), rewards.abs() / (rest * mass)), size)
        size = size.masked_fill(~valid, 0.0)
        self.bound = all_max(self.bound.scatter_reduce(0, self.task_id, size, "amax"))

    def parts(self) -> Parts:
        """As in the base."""
        return super().parts() | {"return_bound": self.bound, "discounted_ones": self.mass, "recent": self.recent}


class Categorical(OffPolicy):
    """The part of a learner with such critics that knows no actor; stands before the learner whose actor it takes."""

    config: CategoricalConfig
    critic: CategoricalCritics
    target_critic: CategoricalCritics
    per_process = (*OffPolicy.per_process, "discounted_ones", "recent")
    critic_network: ClassVar[type[MLP] | None] = None
    returns_type = ReturnBound
    returns: ReturnBound

    def _make_critics(self, inputs: Inputs, heads: int) -> CategoricalCritics:
        network = self.critic_network or network_of(self.config)
        return CategoricalCritics(inputs, heads, self.config, self.initial, self.num_critics, network)

    def _log_probs(self, critic: CategoricalCritics, obs: Tensor, actions: Tensor) -> Tensor:
        tasks = self.task_of_draw.repeat(len(obs) // len(self.task_of_draw))
        with autocast(self.device, self.low_precision):
            return critic.log_probs(obs, actions, tasks)

    def _pooled(self, values: Tensor) -> Tensor:
        return values.amin(0) if self.config.clipped_double_q else values.mean(0)

    def _following(self, next_obs: Tensor, next_actions: Tensor) -> Tensor:
        probs = self._log_probs(self.target_critic, next_obs, next_actions).exp()
        if not self.config.clipped_double_q:
            return probs.mean(0)
        lower = self.critic.atoms.mean(probs).argmin(0)
        return probs.gather(0, lower.view(1, -1, 1).expand(1, -1, probs.shape[2]))[0]

    def _projected(self, draw: Transitions, following: Tensor, bonus: Tensor) -> Tensor:
        """Targets (B, atoms): the distribution of scaled reward + gamma^steps * (bonus + Z), Z as ``following``."""
        shift = self._bootstrapped(draw, bonus)
        factor = (self.gamma_of_draw**draw.steps) * (~draw.terminated).to(shift.dtype)
        return self.critic.atoms.projected(following, shift, factor)

    def _reward_scale(self) -> Tensor:
        scale = super()._reward_scale()
        return (
            torch.maximum(scale, self.returns.bound / self.config.value_bound)
            if self.config.per_task_rewards
            else scale
        )

    def _critic_losses(self, obs: Tensor, actions: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        log_probs = self._log_probs(self.critic, obs, actions)[:, : len(target)]
        values = self.critic.atoms.mean(log_probs[0].detach().exp())
        return -(target * log_probs).sum(2), values

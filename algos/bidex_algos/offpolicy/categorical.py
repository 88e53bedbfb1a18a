"""The base of FastTD3, BRC and FlashSAC: critics that predict a distribution of the return, trained by cross-entropy.

The distribution Z(s, a) gives probabilities to fixed values ("atoms"). Targets r + gamma (1 - terminated) Z'(s', a')
are projected back onto the atoms (C51, Bellemare et al. 2017, arXiv 1707.06887). Unlike in regression, the gradient
does not grow with the scale of a task's returns. However, rewards must be divided so that the task's largest return
(``ReturnBound``) lies within the atoms' range.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from msgspec import Meta
from torch import Tensor, nn

from bidex_algos.nets.architecture import network_bytes, network_of, shares_a_trunk
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
    """``count`` (A >= 2) evenly spaced values, to which a distribution gives probabilities; has no weights."""

    def __init__(self, low: float, high: float, count: int):
        super().__init__()
        self.low = low
        self.high = high
        self.count = count
        self.values: Tensor
        self.register_buffer("values", torch.linspace(low, high, count), persistent=False)

    def mean(self, probs: Tensor) -> Tensor:
        """Return expected values (...) of distributions (..., A)."""
        return (probs * self.values).sum(-1)

    def projected(self, probs: Tensor, shift: Tensor, factor: Tensor) -> Tensor:
        """Return the distribution (B, A) of shift + factor * Z on the atoms, with Z distributed as ``probs`` (B, A).

        Probability between two atoms is split so that its mean does not change. Probability beyond the range goes to
        the atom at that end. ``shift`` and ``factor`` are (B,).
        """
        moved = shift[:, None] + factor[:, None] * self.values
        # These are positions in units of the distance between two atoms, counted from the lowest.
        place = (moved.clamp(self.low, self.high) - self.low) * ((self.count - 1) / (self.high - self.low))
        share = place - place.floor()
        # NaN must stay NaN and must not become an index.
        index = place.long().clamp(0, self.count - 1)
        out = torch.zeros_like(probs).scatter_add_(1, index, probs * (1.0 - share))
        return out.scatter_add_(1, (index + 1).clamp_max(self.count - 1), probs * share)


@dataclass(frozen=True)
class CategoricalConfig(OffPolicyConfig):
    """Options of the critics' distributions and layers, in addition to the options of all off-policy learners."""

    critic_hidden: Layers = (256, 256)  # Widths of the critics' hidden layers; hidden only applies to the actor.
    atoms: Annotated[int, Meta(ge=2, le=MOST)] = 101  # Number of values over which a return's distribution is defined.
    value_bound: Positive = 10.0  # The atoms are evenly spaced from minus this value to this value, in scaled rewards.
    clipped_double_q: bool = True  # Targets and actor use the critic with the lower value; off: the mean of both.

    def bytes_held(self, num_envs: int, width: int) -> int:
        """Estimate the memory that the learner takes, in bytes.

        The base class assumes that all networks have the layers ``hidden``. To its estimate this method adds the size
        of the critics, which have their own layers.
        """
        return super().bytes_held(num_envs, width) + network_bytes((*self.critic_hidden, self.atoms), width, 2)


def check_residual(config: CategoricalConfig) -> None:
    """Raise BidexError if a config's options are not those of residual networks."""
    if not shares_a_trunk(config.architecture):
        raise BidexError(f"{config.algo}: its networks are residual; architecture must be shared or multi_head.")
    if not config.critic_layer_norm:
        raise BidexError(f"{config.algo}: its critics have norms of their own; leave critic_layer_norm out.")
    for name, widths in (("hidden", config.hidden), ("critic_hidden", config.critic_hidden)):
        if len(set(widths)) != 1:
            raise BidexError(f"{config.algo}: {name} must be one width, once or more often, got {widths}.")


class CategoricalCritics(nn.Module):
    """Networks of observation and action that predict distributions; arguments as for ``Critics``."""

    def __init__(
        self, inputs: int | Inputs, heads: int, config: CategoricalConfig, generator: torch.Generator, count: int,
        network: MakeNetwork
    ):  # fmt: skip
        super().__init__()
        self.heads = heads
        self.atoms = Atoms(-config.value_bound, config.value_bound, config.atoms)
        outputs = heads * config.atoms
        norm = config.critic_layer_norm
        given = inputs, config.critic_hidden, outputs, 0.01, generator, config.activation, norm
        nets = [network(*given) for _ in range(count)]
        # At first the mean is 0 and the standard deviation a tenth of the bound. From a uniform distribution, which is
        # much wider, means would move slowly, because the gradient of a cross-entropy on them scales with the inverse
        # variance.
        place = self.atoms.values / (0.1 * config.value_bound)
        with torch.no_grad():
            for net in nets:
                net.output_bias.view(heads, -1).copy_(-0.5 * place.square())
        self.nets = nn.ModuleList(nets)

    def log_probs(self, obs: Tensor, actions: Tensor, task_id: Tensor) -> Tensor:
        """Return each atom's log-probability (count, B, atoms) for actions (B, a) and tasks (B,).

        ``obs`` (B, d) are normalised observations.
        """
        x = torch.cat([obs, actions], dim=1)
        logits = torch.stack([net(x) for net in self.nets])
        if self.heads > 1:
            head = task_id.view(1, -1, 1, 1).expand(len(logits), -1, 1, self.atoms.count)
            logits = logits.unflatten(2, (self.heads, -1)).gather(2, head).squeeze(2)
        return torch.log_softmax(logits, dim=2)

    def forward(self, obs: Tensor, actions: Tensor, task_id: Tensor) -> Tensor:
        """Return expected values (count, B); arguments as for :meth:`log_probs`."""
        return self.atoms.mean(self.log_probs(obs, actions, task_id).exp())


RECENT = 0.9  # decay per step of the mean of recent rewards, so that about the last ten steps count


class ReturnBound(ReturnScale):
    """Statistics of returns that also hold the largest absolute return of each task.

    The largest return is needed because rewards are scaled so that returns lie within the atoms. A sum discounts
    earlier rewards instead of later ones, because the end of the episode is not known yet. With constant rewards the
    sums are the same in both directions. If an episode has large rewards at its start, its return may be up to twice
    the bound, and then saturates at the last atom. At a time limit the episode is assumed to continue
    with its mean reward, or with the mean of its most recent rewards if that is larger. ``mass`` (N,) is the sum that
    would result if all rewards had been 1. ``recent`` (2, N) holds two sums with a discount of at most :data:`RECENT`:
    the sum of the rewards, and the sum that would result if all rewards had been 1.
    """

    def __init__(self, world: VectorWorld, gamma: float | Tensor, horizon: float):
        super().__init__(world, gamma, horizon)
        self.bound = torch.zeros(world.num_tasks, device=world.device)
        self.mass = torch.zeros(world.num_envs, device=world.device)
        self.recent = torch.zeros(2, world.num_envs, device=world.device)
        self.short = torch.as_tensor(gamma, device=world.device).clamp_max(RECENT)

    def note(self, reward: Tensor, terminated: Tensor, truncated: Tensor, broken: Tensor) -> None:
        """Add one step of all environments to the reward scale, and to the sums that give the largest return.

        The arguments are described in :meth:`ReturnScale.note`.
        """
        self.mass = self.gamma * self.mass + 1.0
        self.recent = self.short * self.recent + torch.stack([reward, torch.ones_like(reward)])
        super().note(reward, terminated, truncated, broken)
        over = terminated | truncated | broken
        self.mass = self.mass.masked_fill(over, 0.0)
        self.recent = self.recent.masked_fill(over, 0.0)

    def _take(self, cut: Tensor, valid: Tensor) -> None:
        super()._take(cut, valid)
        size = self.discounted.abs()
        rewards, mass = self.recent
        rest = 1.0 - self.gamma
        size = torch.where(cut, torch.maximum(size / (rest * self.mass), rewards.abs() / (rest * mass)), size)
        size = size.masked_fill(~valid, 0.0)
        self.bound = all_max(self.bound.scatter_reduce(0, self.task_id, size, "amax"))

    def parts(self) -> Parts:
        """Return the tensors and statistics that a checkpoint stores, by name."""
        return super().parts() | {"return_bound": self.bound, "discounted_ones": self.mass, "recent": self.recent}


class Categorical(OffPolicy):
    """The part of a learner with categorical critics that does not depend on the actor.

    A subclass with several bases lists this class before the learner whose actor is used.
    """

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
        if self.config.clipped_double_q:
            return values.amin(0)
        return values.mean(0)

    def _following(self, next_obs: Tensor, next_actions: Tensor) -> Tensor:
        probs = self._log_probs(self.target_critic, next_obs, next_actions).exp()
        if not self.config.clipped_double_q:
            return probs.mean(0)
        lower = self.critic.atoms.mean(probs).argmin(0)
        return probs.gather(0, lower.view(1, -1, 1).expand(1, -1, probs.shape[2]))[0]

    def _projected(self, draw: Transitions, following: Tensor, bonus: Tensor) -> Tensor:
        """Return targets (B, atoms): the distribution of scaled reward + gamma^steps * (bonus + Z).

        The distribution of Z is ``following``.
        """
        shift = self._bootstrapped(draw, bonus)
        factor = (self.gamma_of_draw**draw.steps) * (~draw.terminated).to(shift.dtype)
        return self.critic.atoms.projected(following, shift, factor)

    def _reward_scale(self) -> Tensor:
        scale = super()._reward_scale()
        if self.config.per_task_rewards:
            return torch.maximum(scale, self.returns.bound / self.config.value_bound)
        return scale

    def _critic_losses(self, obs: Tensor, actions: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        log_probs = self._log_probs(self.critic, obs, actions)[:, : len(target)]
        values = self.critic.atoms.mean(log_probs[0].detach().exp())
        return -(target * log_probs).sum(2), values

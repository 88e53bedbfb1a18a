"""PPO's loss (Schulman et al. 2017, equations 7 and 9), mini-batches, and Adam with a step size that follows the KL."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from bidex_algos.nets.networks import gaussian_entropy, gaussian_kl, gaussian_log_prob
from bidex_meta.training.distributed import all_sum
from bidex_meta.training.learner import LearnerConfig, Parts, State
from bidex_meta.utils.validation import Count, Positive, check_rising


@dataclass(frozen=True)
class PPOConfig(LearnerConfig):
    """Options of epochs, clipping and adaptive step sizes. With several base classes, these options come last."""

    num_minibatches: Count = 4  # Mini-batches per epoch; each holds shuffled samples of all environments.
    epochs: Count = 4  # Passes over the collected data per update.
    clip: Positive = 0.2  # Distance of the likelihood ratio from 1 at which the objective is clipped.
    learning_rate: Positive = 3e-4  # Adam's initial step size.
    desired_kl: Positive = 0.03
    """Desired KL of the sampling policy from the current policy. The step size is divided by 1.5 if the KL is above
    twice this value, and multiplied by 1.5 if the KL is below half of it."""
    learning_rate_range: tuple[Positive, Positive] = (1e-5, 1e-2)  # Bounds of the adaptive step size.
    critic_learning_rate: Positive | None = 1e-3  # Fixed step size for the critic; None: the same as the actor's.

    def __post_init__(self) -> None:
        super().__post_init__()
        check_rising(self, self.algo, "learning_rate_range")


@dataclass(frozen=True)
class OptionalRateConfig(PPOConfig):
    """PPO's options, and a switch that keeps the step size constant."""

    adaptive_learning_rate: bool = True  # Adapt the step size to desired_kl; if off, the step size is constant.

    @property
    def followed_kl(self) -> float | None:
        """Return the KL that the step size follows, or None if the step size stays the same."""
        return self.desired_kl if self.adaptive_learning_rate else None


def mini_batches(
    weights: Tensor, epochs: int, number: int, generator: torch.Generator,
    split: Callable[[Tensor, int], Sequence[Tensor]] = Tensor.chunk
) -> Iterator[tuple[bool, Tensor, Tensor]]:  # fmt: skip
    """Yield shuffled mini-batches of all samples, for several epochs.

    ``weights`` (B,) are the weights of the samples. Each epoch shuffles all samples and divides them into ``number``
    mini-batches. For each mini-batch, three values are yielded: whether it is the first of all, the indices of its
    samples, int64 (b,), and the sum of these samples' weights over all processes (at least 1).
    """
    for epoch in range(epochs):
        parts = split(torch.randperm(len(weights), generator=generator, device=weights.device), number)
        counts = all_sum(torch.stack([weights[index].sum() for index in parts])).clamp_min(1.0)
        for part, (index, count) in enumerate(zip(parts, counts, strict=True)):
            yield (epoch, part) == (0, 0), index, count


class PolicyLoss(NamedTuple):
    """Losses of a policy; all are scalars except ``earned``. With weights that sum to 1 the losses are means."""

    surrogate: Tensor  # minus the clipped surrogate objective: min(ratio A, clip(ratio, 1 - eps, 1 + eps) A)
    entropy: Tensor  # entropy of the policy
    kl: Tensor  # KL of the sampling policy from the current policy; without a gradient
    outside: Tensor  # share of the ratios outside the clip range; without a gradient
    earned: Tensor  # the surrogate objective of each sample, weighted (...)

    def numbers(self, value: Tensor) -> list[Tensor]:
        """Return the losses and statistics to be logged, without gradients, in the order of :data:`NAMES`.

        ``value`` is the critic's loss.
        """
        return [self.surrogate.detach(), value.detach(), self.kl, self.outside]


NAMES = ("Loss/surrogate", "Loss/value", "Policy/kl", "Policy/clip_fraction")  # tags of :meth:`PolicyLoss.numbers`


def policy_loss(
    actions: Tensor, means: Tensor, log_std: Tensor, old_means: Tensor, old_log_std: Tensor, old_log_probs: Tensor,
    advantages: Tensor, weights: Tensor, clip: float
) -> PolicyLoss:  # fmt: skip
    """Return the loss of samples of any shape (...), summed with ``weights`` (...).

    A weight of 0 excludes a sample. Actions and means are (..., a), log standard deviations (a,) or (..., a),
    log-densities and normalised advantages (...). ``old`` refers to the sampling policy. The objective clips the
    probability ratio to [1 - ``clip``, 1 + ``clip``].
    """
    ratio = torch.exp(gaussian_log_prob(actions, means, log_std) - old_log_probs)
    clipped = ratio.clamp(1.0 - clip, 1.0 + clip)
    earned = weights * torch.minimum(ratio * advantages, clipped * advantages)
    entropy = (weights * gaussian_entropy(log_std)).sum()
    with torch.no_grad():
        kl = (weights * gaussian_kl(old_means, old_log_std, means, log_std)).sum()
        outside = (weights * ((ratio - 1.0).abs() > clip)).sum()
    return PolicyLoss(-earned.sum(), entropy, kl, outside, earned)


def factor_of(kl: Tensor, desired_kl: float) -> Tensor:
    """Return the factor of a step size: 1 / 1.5 if the KL is above twice ``desired_kl``, 1.5 if below half, else 1."""
    return torch.where(kl < 0.5 * desired_kl, 1.5, torch.where(kl > 2.0 * desired_kl, 1.0 / 1.5, 1.0))


class _Adam(torch.optim.Adam):
    """Adam whose step size is a tensor that remains the same tensor when a state is loaded.

    Changes of this tensor therefore also affect an optimiser that was restored. On CUDA the steps can be recorded in a
    graph.
    """

    def __init__(self, weights: list[nn.Parameter], rate: Tensor, eps: float = 1e-8) -> None:
        super().__init__(weights, lr=rate, eps=eps, fused=True, capturable=rate.device.type == "cuda")

    def load_state_dict(self, state_dict: State) -> None:
        kept = [{name: group[name] for name in ("lr", "capturable")} for group in self.param_groups]
        super().load_state_dict(state_dict)
        for group, own in zip(self.param_groups, kept, strict=True):
            group.update(own)


class AdaptiveAdam:
    """Adam whose step size is multiplied by :func:`factor_of` of the last step's KL before each step.

    The step size is a tensor, so the host does not wait for the device. If ``desired_kl`` is None, the step size is
    constant.
    """

    def __init__(
        self, parameters: Iterable[nn.Parameter], learning_rate: float, bounds: tuple[float, float],
        desired_kl: float | None, device: torch.device, eps: float = 1e-8
    ):  # fmt: skip
        self.desired_kl = desired_kl
        self.bounds = bounds
        self.weights = list(parameters)
        self.rate = torch.tensor(learning_rate, device=device)
        self.actor = _Adam(self.weights, self.rate, eps)

    def zero_grad(self) -> None:
        """Reset the gradients."""
        self.actor.zero_grad()

    def descend(self, kl: Tensor | None, max_grad_norm: float) -> None:
        """Adapt the step size to the last step's KL (None at first), then take one step along clipped gradients."""
        self.follow(kl)
        nn.utils.clip_grad_norm_(self.weights, max_grad_norm)
        self.actor.step()

    def follow(self, kl: Tensor | None) -> None:
        """Adapt the step size to the KL of the last step, a scalar; None leaves it unchanged."""
        if kl is not None and self.desired_kl is not None:
            self.rate.mul_(factor_of(kl, self.desired_kl)).clamp_(*self.bounds)

    def parts(self) -> Parts:
        """Return optimiser and step size, by their names in a checkpoint."""
        return {"actor_adam": self.actor, "learning_rate": self.rate}


class AdaptiveAdams(AdaptiveAdam):
    """Adam for the actor and Adam for the critic.

    ``critic_learning_rate`` is the critic's fixed step size. With None the critic uses the actor's step size, and
    ``learning_rate`` while it learns alone.
    """

    def __init__(
        self, actor: Iterable[nn.Parameter], critic: Iterable[nn.Parameter], learning_rate: float,
        bounds: tuple[float, float], desired_kl: float | None, critic_learning_rate: float | None, device: torch.device
    ):  # fmt: skip
        super().__init__(actor, learning_rate, bounds, desired_kl, device)
        self.learning_rate = learning_rate
        if critic_learning_rate is None:
            self.critic_rate = self.rate
        else:
            self.critic_rate = torch.tensor(critic_learning_rate, device=device)
        self.critic_weights = list(critic)
        self.critic = _Adam(self.critic_weights, self.critic_rate)

    def zero_grad(self) -> None:
        """Reset the gradients of actor and critic."""
        super().zero_grad()
        self.critic.zero_grad()

    def descend(self, kl: Tensor | None, max_grad_norm: float, critic_alone: bool = False) -> None:
        """Take one step of actor and critic, clipped separately; if ``critic_alone``, only the critic takes a step."""
        self.follow(None if critic_alone else kl)
        for weights in (self.weights, self.critic_weights):
            nn.utils.clip_grad_norm_(weights, max_grad_norm)
        if not critic_alone:
            self.actor.step()
            self.critic.step()
            return
        # --start-from lowered the shared step size for the actor. The critic learns alone with the original one.
        of_actor = self.rate.clone()
        if self.critic_rate is self.rate:
            self.rate.fill_(self.learning_rate)
        self.critic.step()
        self.rate.copy_(of_actor)

    def parts(self) -> Parts:
        """Return both optimisers and the step size, by their names in a checkpoint."""
        return super().parts() | {"critic_adam": self.critic}

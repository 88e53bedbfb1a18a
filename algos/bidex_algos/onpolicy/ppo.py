"""PPO's loss (Schulman et al. 2017, equations 7 and 9): of MT-PPO's transitions and of RL²'s chunks of trials."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from bidex_algos.nets.networks import gaussian_entropy, gaussian_kl, gaussian_log_prob
from bidex_meta.train.distributed import all_sum
from bidex_meta.train.learner import LearnerConfig
from bidex_meta.utils.validation import Count, Positive, check_rising


@dataclass(frozen=True)
class PPOConfig(LearnerConfig):
    """Passes, clip and step sizes. A config that is made of this and others puts its fields behind theirs."""

    num_minibatches: Count = 4
    """Mini-batches per epoch; each holds shuffled samples of all environments."""
    epochs: Count = 4
    """Passes over what was collected, per update."""
    clip: Positive = 0.2
    """How far the likelihood ratio may leave 1 before it earns nothing more."""
    learning_rate: Positive = 3e-4
    """Adam's step size at the start."""
    adaptive_learning_rate: bool = True
    """Divide the step size by 1.5 when the KL exceeds twice desired_kl, multiply it when below half."""
    desired_kl: Positive = 0.03
    """KL of the sampling policy from the current one that the adaptive step size aims at."""
    learning_rate_range: tuple[Positive, Positive] = (1e-5, 1e-2)
    """Bounds of the adaptive step size."""
    critic_learning_rate: Positive | None = 1e-3
    """A fixed step size for the critic; None makes it follow the actor's."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_rising(self, self.algo, "learning_rate_range")


def mini_batches(
    weights: Tensor,
    epochs: int,
    number: int,
    generator: torch.Generator,
    split: Callable[[Tensor, int], Sequence[Tensor]] = Tensor.chunk,
) -> Iterator[tuple[bool, Tensor, Tensor]]:
    """Passes over shuffled samples with ``weights`` (B,), in the order of PPO's epochs.

    Divided by the count, which is of all processes, losses and gradients become means by being summed over them. Yields
    whether it is the very first, the samples int64 (b,), and the sum of their weights, at least 1.
    """
    for epoch in range(epochs):
        parts = split(torch.randperm(len(weights), generator=generator, device=weights.device), number)
        counts = all_sum(torch.stack([weights[index].sum() for index in parts])).clamp_min(1.0)
        for part, (index, count) in enumerate(zip(parts, counts, strict=True)):
            yield (epoch, part) == (0, 0), index, count


class PolicyLoss(NamedTuple):
    """Losses of a policy; scalars but for ``earned``. With weights that sum to 1 they are means."""

    surrogate: Tensor  # minus the clipped surrogate objective: min(ratio A, clip(ratio, 1 - eps, 1 + eps) A)
    entropy: Tensor  # entropy of the policy
    kl: Tensor  # KL of the sampling policy from the present one; without a gradient
    outside: Tensor  # share of the ratios outside the clip range; without a gradient
    earned: Tensor  # the surrogate objective of each sample, weighted (...)

    def numbers(self, value: Tensor) -> list[Tensor]:
        """What :data:`NAMES` names, without gradients; ``value`` is the critic's loss."""
        return [self.surrogate.detach(), value.detach(), self.kl, self.outside]


NAMES: tuple[str, ...] = ("Loss/surrogate", "Loss/value", "Policy/kl", "Policy/clip_fraction")
"""Tags of :meth:`PolicyLoss.numbers`."""


def policy_loss(
    actions: Tensor, means: Tensor, log_std: Tensor, old_means: Tensor, old_log_std: Tensor, old_log_probs: Tensor,
    advantages: Tensor, weights: Tensor, clip: float
) -> PolicyLoss:  # fmt: skip
    """The loss of samples of any shape (...), summed with ``weights`` (...), 0 for those that teach nothing.

    Actions and means are (..., a), logarithms of deviations (a,) or (..., a), log-densities and normalised advantages
    (...); ``old`` is the sampling policy's. A ratio beyond ``clip`` of 1 earns nothing more.
    """
    ratio = torch.exp(gaussian_log_prob(actions, means, log_std) - old_log_probs)
    clipped = ratio.clamp(1.0 - clip, 1.0 + clip)
    earned = weights * torch.minimum(ratio * advantages, clipped * advantages)
    entropy = (weights * gaussian_entropy(log_std)).sum()
    with torch.no_grad():
        kl = (weights * gaussian_kl(old_means, old_log_std, means, log_std)).sum()
        outside = (weights * ((ratio - 1.0).abs() > clip)).sum()
    return PolicyLoss(-earned.sum(), entropy, kl, outside, earned)

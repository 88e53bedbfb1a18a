"""The inner loop of MAML and ProMP: one gradient step on a task's own data, for all tasks at once.

Every task has parameters of its own, stacked along a first axis; ``torch.func`` maps forward passes and gradients over
it. Adapted parameters keep their graph back to the meta-parameters, which is what the outer loops differentiate.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor
from torch.func import functional_call, grad, vmap

from bidex_algos.choices import Adapted
from bidex_algos.networks import GaussianActor, gaussian_kl, gaussian_log_prob, stacked_forward

Params = dict[str, Tensor]
"""Parameters of an actor by name; stacked ones have a first axis of tasks."""

Objective = Literal["likelihood", "ratio"]
"""What the inner step follows: log-likelihood times advantage (MAML), or likelihood ratio times advantage (ProMP)."""


@dataclass
class TaskBatch:
    """What was sampled in one stage of adaptation, by task: B transitions of each of M tasks."""

    obs: Tensor
    """Normalised observations (M, B, d)."""
    actions: Tensor
    """Sampled actions (M, B, a)."""
    old_means: Tensor
    """Means of the policies that sampled (M, B, a)."""
    old_log_stds: Tensor
    """Logarithms of their standard deviations (M, a)."""
    advantages: Tensor
    """Normalised within each task (M, B)."""
    weights: Tensor
    """1, or 0 for what teaches nothing: after an episode's end, or where physics broke (M, B)."""

    def tensors(self) -> tuple[Tensor, ...]:
        """The fields, in order."""
        return tuple(vars(self).values())


class Adapter:
    """Gradient steps on parameters of an actor.

    Args:
        actor: Gives the functional form; its own parameters are the meta-parameters.
        learning_rate: Size of an inner step.
        objective: What the inner step follows.
        std_range: Bounds of the standard deviations, wherever they are used.
        first_order: Whether the outer loop takes the inner gradient for a constant.
        adapted: Which parameters the inner step moves: all of them, or those of the output layer.
    """

    def __init__(
        self,
        actor: GaussianActor,
        learning_rate: float,
        objective: Objective,
        std_range: tuple[float, float],
        first_order: bool = False,
        adapted: Adapted = "all",
    ):
        self.actor, self.learning_rate, self.objective, self.first_order = actor, learning_rate, objective, first_order
        self._prefix = "mean.head." if adapted == "head" else ""
        self.log_std_range = math.log(std_range[0]), math.log(std_range[1])

    @torch.no_grad()
    def project(self) -> None:
        """Moves the meta-parameters' standard deviations back between their bounds: beyond one no gradient would."""
        self.actor.log_std.clamp_(*self.log_std_range)

    def meta(self, count: int) -> Params:
        """The meta-parameters once per task, a view with their graph."""
        return {name: p.expand(count, *p.shape) for name, p in self.actor.named_parameters()}

    def distribution(self, params: Params, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Means (M, B, a) and logarithms of standard deviations (M, a) of all tasks' policies for (M, B, d)."""
        means = stacked_forward(self.actor.mean, params, "mean.", obs)
        return means, params["log_std"].clamp(*self.log_std_range)

    def adapt(self, params: Params, batch: TaskBatch) -> Params:
        """Parameters after one inner step of each task on its own batch."""
        own = {name: p for name, p in params.items() if name.startswith(self._prefix)}
        shared = {name: p[0] for name, p in params.items() if name not in own}  # never moved: alike in all tasks
        tensors = batch.tensors()
        slopes = vmap(grad(self._loss), in_dims=(0, None, *[0] * len(tensors)))(own, shared, *tensors)
        if self.first_order:
            slopes = {name: slope.detach() for name, slope in slopes.items()}
        return params | {name: p - self.learning_rate * slopes[name] for name, p in own.items()}

    def _loss(self, own: Params, shared: Params, *tensors: Tensor) -> Tensor:
        """The inner loss of one task, by the parameters that move and those that do not."""
        b = TaskBatch(*tensors)
        log_prob = self._log_prob(own | shared, b)
        if self.objective == "ratio":
            gain = torch.exp(log_prob - gaussian_log_prob(b.actions, b.old_means, b.old_log_stds)) * b.advantages
        else:
            gain = log_prob * b.advantages
        return -weighted_mean(gain, b.weights)

    def _log_prob(self, params: Params, b: TaskBatch) -> Tensor:
        mean = functional_call(self.actor, params, (b.obs,))
        return gaussian_log_prob(b.actions, mean, params["log_std"].clamp(*self.log_std_range))

    def ratio_and_kl(self, params: Params, batch: TaskBatch) -> tuple[Tensor, Tensor]:
        """Likelihood ratios of each transition (M, B), and the mean KL from the policies that sampled (M,)."""

        def one(p: Params, *tensors: Tensor) -> tuple[Tensor, Tensor]:
            b = TaskBatch(*tensors)
            mean = functional_call(self.actor, p, (b.obs,))
            log_std = p["log_std"].clamp(*self.log_std_range)
            ratio = torch.exp(
                gaussian_log_prob(b.actions, mean, log_std) - gaussian_log_prob(b.actions, b.old_means, b.old_log_stds)
            )
            kl = gaussian_kl(b.old_means, b.old_log_stds, mean, log_std)
            return ratio, weighted_mean(kl, b.weights)

        mapped: Callable[..., Any] = vmap(one)
        return mapped(params, *batch.tensors())


def weighted_mean(x: Tensor, weights: Tensor) -> Tensor:
    """Mean over the last axis of what has weight; 0 where nothing has."""
    return (weights * x).sum(-1) / weights.sum(-1).clamp_min(1.0)


def detached(params: Params) -> Params:
    """The same numbers without their graph."""
    return {name: p.detach() for name, p in params.items()}

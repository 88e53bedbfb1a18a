"""The inner loop of MAML and ProMP: one gradient step on a task's own data, for all tasks at once.

Every task has its own parameters, stacked along a first axis. Adapted parameters keep their graph back to the
meta-parameters, because the outer loops differentiate through it.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.func import grad

from bidex_algos.nets.networks import GaussianActor, gaussian_kl, gaussian_log_prob, stacked_forward

Adapted = Literal["all", "head"]  # parameters that an inner step moves: all, or only the output layer of the mean
StepSizeKind = Literal["fixed", "layer", "weight"]  # granularity of learned inner step sizes; fixed: not learned


class StepSizes(nn.Module):
    """Learned factors by which the inner step size of MAML and ProMP is multiplied.

    Each parameter tensor that the inner step changes has one factor (``layer``), or one factor per entry (``weight``).
    """

    def __init__(self, actor: nn.Module, moved: list[str], kind: StepSizeKind):
        super().__init__()
        sizes = {name: p.shape if kind == "weight" else () for name, p in actor.named_parameters() if name in moved}
        self.factors = nn.ParameterDict({_key(name): torch.ones(size) for name, size in sizes.items()})

    def __getitem__(self, name: str) -> Tensor:
        """Return the factor of the inner step size for the parameter called ``name``.

        The factor is a scalar, or a tensor of the parameter's shape.
        """
        return self.factors[_key(name)]

    @torch.no_grad()
    def project(self) -> None:
        """Raise negative factors to 0, because with a negative factor the inner step would go uphill."""
        for factor in self.parameters():
            factor.clamp_(min=0.0)

    @torch.no_grad()
    def mean(self) -> Tensor:
        """Return the mean over all entries of all factors, a scalar."""
        return torch.cat([factor.flatten() for factor in self.parameters()]).mean()


def _key(name: str) -> str:
    """Replace the dots of a parameter's name, because a ParameterDict does not accept dots."""
    return name.replace(".", "/")


Params = dict[str, Tensor]  # parameters of an actor by name; stacked ones have a first axis of tasks

Objective = Literal["likelihood", "ratio"]
"""Objective of the inner step: log-likelihood times advantage (MAML), or likelihood ratio times advantage (ProMP)."""

_TRANSITIONS_AT_ONCE = 8_192  # fit a CPU's caches with two layers of 64; all tasks at once take 1.5 times as long


@dataclass
class TaskBatch:
    """The samples of one stage of adaptation, by task: B transitions for each of M tasks."""

    obs: Tensor  # normalised observations (M, B, d)
    actions: Tensor  # sampled actions (M, B, a)
    old_means: Tensor  # means of the sampling policies (M, B, a)
    old_log_stds: Tensor  # logarithms of the sampling policies' standard deviations (M, a)
    advantages: Tensor  # advantages, normalised within each task (M, B)
    weights: Tensor  # 0 for steps after an episode's end and for steps in which physics broke, otherwise 1 (M, B)

    def tensors(self) -> tuple[Tensor, ...]:
        """Return the values of all fields, in the order in which the class declares them."""
        return tuple(vars(self).values())


class Adapter:
    """Takes gradient steps for all tasks, starting from the parameters of ``actor``, which are the meta-parameters.

    ``MetaConfig`` describes the options.
    """

    def __init__(
        self, actor: GaussianActor, learning_rate: float, objective: Objective, std_range: tuple[float, float],
        first_order: bool = False, adapted: Adapted = "all", step_sizes: StepSizeKind = "fixed"
    ):  # fmt: skip
        self.actor = actor
        self.learning_rate = learning_rate
        self.objective = objective
        self.first_order = first_order
        if adapted == "head":
            self._prefix = "mean.head."
        else:
            self._prefix = ""
        self.log_std_range = math.log(std_range[0]), math.log(std_range[1])
        moved = self._moved([name for name, _ in actor.named_parameters()])
        if step_sizes == "fixed":
            self.step_sizes = None
        else:
            self.step_sizes = StepSizes(actor, moved, step_sizes)

    @torch.no_grad()
    def project(self) -> None:
        """Clamp standard deviations and step sizes to their bounds, because beyond a bound they get no gradient."""
        self.actor.log_std.clamp_(*self.log_std_range)
        if self.step_sizes is not None:
            self.step_sizes.project()

    def meta(self, count: int) -> Params:
        """Return the meta-parameters repeated for ``count`` tasks, as views that keep their graph."""
        return {name: p.expand(count, *p.shape) for name, p in self.actor.named_parameters()}

    def distribution(self, params: Params, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Return all tasks' means (M, B, a) and logarithms of standard deviations (M, a) for observations (M, B, d)."""
        means = stacked_forward(self.actor.mean, params, "mean.", obs, own=self._prefix)
        return means, params["log_std"].clamp(*self.log_std_range)

    def adapt(self, params: Params, batch: TaskBatch) -> Params:
        """Return the parameters after one inner step of each task on its own batch."""
        moved = self._moved(list(params))
        slopes_of_parts = [self._slopes(*part, moved) for part in _parts(params, batch)]
        adapted = dict(params)
        for name in moved:
            slope = torch.cat([slopes[name] for slopes in slopes_of_parts])
            if self.first_order:
                slope = slope.detach()
            adapted[name] = params[name] - self._step_size(name) * slope
        return adapted

    def _step_size(self, name: str) -> float | Tensor:
        if self.step_sizes is None:
            return self.learning_rate
        return self.learning_rate * self.step_sizes[name]

    def _moved(self, names: list[str]) -> list[str]:
        return [name for name in names if name.startswith(self._prefix)]

    def _slopes(self, params: Params, batch: TaskBatch, own: list[str]) -> Params:

        def loss(moved: Params) -> Tensor:
            means, log_stds = self.distribution(params | moved, batch.obs)
            log_prob = gaussian_log_prob(batch.actions, means, log_stds[:, None])
            if self.objective == "ratio":
                followed = torch.exp(log_prob - _old_log_prob(batch))
            else:
                followed = log_prob
            return -weighted_mean(followed * batch.advantages, batch.weights).sum()

        return grad(loss)({name: params[name] for name in own})

    def ratio_and_kl(self, params: Params, batch: TaskBatch) -> tuple[Tensor, Tensor]:
        """Return likelihood ratios of each transition (M, B), and the mean KL from the sampling policies (M,)."""
        means, log_stds = self.distribution(params, batch.obs)
        log_prob = gaussian_log_prob(batch.actions, means, log_stds[:, None])
        kl = gaussian_kl(batch.old_means, batch.old_log_stds[:, None], means, log_stds[:, None])
        return torch.exp(log_prob - _old_log_prob(batch)), weighted_mean(kl, batch.weights)


def _old_log_prob(b: TaskBatch) -> Tensor:
    return gaussian_log_prob(b.actions, b.old_means, b.old_log_stds[:, None])


def _parts(params: Params, batch: TaskBatch) -> Iterator[tuple[Params, TaskBatch]]:
    tasks, transitions = batch.weights.shape
    if batch.obs.device.type == "cpu":
        size = max(1, _TRANSITIONS_AT_ONCE // transitions)
    else:
        size = tasks
    for k in range(0, tasks, size):
        part = slice(k, k + size)
        yield {name: p[part] for name, p in params.items()}, TaskBatch(*(x[part] for x in batch.tensors()))


def weighted_mean(x: Tensor, weights: Tensor) -> Tensor:
    """Average over the last axis the entries of ``x`` whose weight is 1; return 0 if all weights are 0."""
    return (weights * x).sum(-1) / weights.sum(-1).clamp_min(1.0)


def detached(params: Params) -> Params:
    """Return the same parameters without their graph."""
    return {name: p.detach() for name, p in params.items()}

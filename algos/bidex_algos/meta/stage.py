"""The transitions of one stage of adaptation, and the batch, grouped by task, that is made from these transitions."""

from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from bidex_algos.advantages import gae, normalise_per_task, successor_values, task_moments
from bidex_algos.meta.adaptation import TaskBatch
from bidex_algos.meta.config import MetaConfig


class TaskRows:
    """Environments grouped by task, as a rectangle of M tasks by R environments.

    R is the largest number of environments per task. A task with fewer environments repeats one of them, with weight 0.
    ``task_of_row`` is the task of each environment, 0 to ``count`` - 1, int64 (N,). ``weight`` (M, R) is 0 for
    repetitions and 1 otherwise.
    """

    def __init__(self, task_of_row: Tensor):
        self.task_of_row = task_of_row
        self.count = int(task_of_row.max()) + 1
        counts = torch.bincount(task_of_row, minlength=self.count)
        width = int(counts.max())
        order = torch.argsort(task_of_row, stable=True)
        first = counts.cumsum(0) - counts
        column = torch.arange(width, device=task_of_row.device)
        self._table = order[first[:, None] + torch.minimum(column, counts[:, None] - 1)]
        self.weight = (column < counts[:, None]).float()
        # This is the position of each environment in the flattened rectangle.
        place = torch.empty_like(order)
        rank = torch.arange(len(order), device=order.device) - first[task_of_row[order]]
        place[order] = task_of_row[order] * width + rank
        self._place = place

    def by_task(self, x: Tensor) -> Tensor:
        """Rearrange (N, ...) to (M, R, ...)."""
        return x[self._table]

    def by_row(self, x: Tensor) -> Tensor:
        """Rearrange (M, R, ...) back to (N, ...)."""
        return x.flatten(0, 1)[self._place]

    def steps_by_task(self, x: Tensor) -> Tensor:
        """Rearrange (T, N, ...) to (M, T * R, ...)."""
        return x[:, self._table].transpose(0, 1).flatten(1, 2)

    def steps_by_row(self, x: Tensor, steps: int) -> Tensor:
        """Rearrange (M, T * R, ...) back to (T, N, ...)."""
        return x.unflatten(1, (steps, -1)).transpose(0, 1).flatten(1, 2)[:, self._place]


def features(obs: Tensor, elapsed: Tensor) -> Tensor:
    """Return features (..., 2 d + 4) of observations (..., d) and elapsed steps (...), float32.

    The features are the observation, its square, three powers of the time and 1.
    """
    bounded = obs.clamp(-10.0, 10.0)
    t = elapsed[..., None].to(obs.dtype) / 100.0
    return torch.cat([bounded, bounded.square(), t, t.square(), t**3, torch.ones_like(t)], dim=-1)


def fitted(obs: Tensor, elapsed: Tensor, returns: Tensor, weights: Tensor, ridge: float = 1.0) -> Tensor:
    """Fit the returns by ridge regression in each task and return the predictions (tasks, B).

    Observations are (tasks, B, d), all other arguments (tasks, B). The penalty on coefficients of observations is
    ``ridge`` times the number of features per sample, relative to the mean of the Gram matrix's diagonal. The
    coefficients of time and of the constant are hardly penalised. A ``ridge`` of 1 gives the best linear prediction if
    features and noise explain equal parts of the returns.

    A fit with almost no penalty (1e-5) memorises the returns. On ML1-wide we correlated the resulting advantages with
    advantages whose baseline was fitted to other rollouts. With 7, 20 and 50 rollouts the correlations were::

        ridge 1e-5     0.19, 0.18, 0.47
        no baseline    0.71, 0.63, 0.62
        ridge 1        0.78, 0.76, 0.77
    """
    predicted = []
    # The loop runs task by task: features and Gram matrices of all tasks at once take more memory and more time.
    for o, t, r, w in zip(obs, elapsed, returns, weights, strict=True):
        x = features(o, t)
        weighted = x * w[:, None]
        gram = (weighted.T @ x).double()
        diagonal = gram.diagonal()
        # A small penalty on every entry, relative to the mean, allows for linearly dependent features.
        penalty = torch.full_like(diagonal, 1e-5)
        penalty[:-4] += ridge * x.shape[1] / w.sum().clamp_min(1.0)
        diagonal += penalty * diagonal.mean().clamp_min(1.0)
        predicted.append(x.double() @ torch.linalg.solve(gram, (weighted.T @ r).double()))
    return torch.stack(predicted).to(returns.dtype)


@dataclass
class Stage:
    """Transitions of T steps in N environments, in the order of sampling; each list has one entry per step."""

    obs: list[Tensor] = field(default_factory=list)  # normalised observations before the step (N, d)
    actions: list[Tensor] = field(default_factory=list)  # sampled actions, not clamped (N, a)
    means: list[Tensor] = field(default_factory=list)  # means of the sampling policies (N, a)
    rewards: list[Tensor] = field(default_factory=list)  # (N,); 0 if not valid
    terminated: list[Tensor] = field(default_factory=list)  # bool (N,), the episode terminated
    ended: list[Tensor] = field(default_factory=list)  # bool (N,), the episode is over, for whatever reason
    # Bool (N,), False if the environment waited for the others or its physics broke: such a transition teaches nothing.
    valid: list[Tensor] = field(default_factory=list)
    elapsed: list[Tensor] = field(default_factory=list)  # number of earlier steps in the same episode (N,)

    def add(self, **step: Tensor) -> None:
        """Append a step, with every field given by name."""
        for name, value in step.items():
            vars(self)[name].append(value)

    def __len__(self) -> int:
        return len(self.obs)

    def by_task(self, name: str, rows: TaskRows) -> Tensor:
        """Return the field ``name`` of all steps, grouped by task, (M, T * R, ...).

        The field is rearranged step by step to avoid a large copy.
        """
        return torch.stack([rows.by_task(x) for x in vars(self)[name]], dim=1).flatten(1, 2)


@torch.no_grad()
def task_batch(stage: Stage, rows: TaskRows, log_std: Tensor, config: MetaConfig) -> TaskBatch:
    """Make the batch on which tasks adapt; ``log_std`` (M, a) belongs to the sampling policies.

    The return of a step sums rewards only up to the end of the stage, because a baseline fitted to these returns knows
    nothing beyond that point.
    """
    recorded = (stage.rewards, stage.terminated, stage.ended, stage.valid)
    rewards, terminated, ended, valid = (torch.stack(steps) for steps in recorded)
    obs = stage.by_task("obs", rows)
    elapsed = stage.by_task("elapsed", rows)
    nothing = torch.zeros_like(rewards)

    def advantages(values: Tensor, lam: float) -> Tensor:
        following = successor_values(values, nothing[0], ended, nothing)
        return gae(rewards, values, following, terminated, ended, config.gamma, lam, valid)

    weights = rows.steps_by_task(valid.float()) * rows.weight.repeat(1, len(stage))
    returns = advantages(nothing, 1.0)
    values = rows.steps_by_row(fitted(obs, elapsed, rows.steps_by_task(returns), weights), len(stage))
    gained = advantages(values, config.lam)
    scaled = normalise_per_task(gained, rows.task_of_row, rows.count, valid)
    if config.advantage_scale == "variance":
        _, variance, _ = task_moments(gained, rows.task_of_row, rows.count, valid)
        scaled = scaled / (variance.sqrt() + 1e-8)[rows.task_of_row]
    return TaskBatch(
        obs=obs, actions=stage.by_task("actions", rows), old_means=stage.by_task("means", rows),
        old_log_stds=log_std.detach(), advantages=rows.steps_by_task(scaled), weights=weights
    )  # fmt: skip


class Outcome(NamedTuple):
    """Returns, successes and number of steps of one stage of adaptation."""

    earned: Tensor  # undiscounted, unscaled return of each environment (N,)
    success: Tensor  # whether each environment succeeded, bool (N,)
    steps: Tensor  # number of environment steps, int64 (); steps in which an environment waits do not count


def moments(x: Tensor, counted: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean (d,), variance (d,) and count of the rows of ``x`` (N, d) that the mask ``counted`` (N,) selects."""
    count = counted.sum()
    x = x.masked_fill(~counted[:, None], 0.0)
    mean = x.sum(0) / count.clamp_min(1)
    var = ((x - mean).square() * counted[:, None]).sum(0) / count.clamp_min(1)
    return mean, var, count

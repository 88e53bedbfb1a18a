"""One stage of adaptation: what all rows did and got, and the batch by task that is made of it."""

from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from bidex_algos.experience.advantages import gae, normalise_per_task, successor_values, task_moments
from bidex_algos.meta.adaptation import TaskBatch
from bidex_algos.meta.config import MetaConfig
from bidex_algos.meta.linear_baseline import fitted
from bidex_algos.meta.task_rows import TaskRows


@dataclass
class Stage:
    """Transitions of T steps in N rows, in the order they were made; one entry of a list a step."""

    obs: list[Tensor] = field(default_factory=list)
    """Normalised observations before the step (N, d)."""
    actions: list[Tensor] = field(default_factory=list)
    """Sampled actions, not clamped (N, a)."""
    means: list[Tensor] = field(default_factory=list)
    """Means of the sampling policies (N, a)."""
    rewards: list[Tensor] = field(default_factory=list)
    """(N,); 0 where not valid."""
    terminated: list[Tensor] = field(default_factory=list)
    """Bool (N,), the episode came to a true end."""
    ended: list[Tensor] = field(default_factory=list)
    """Bool (N,), the episode is over, for whatever reason."""
    valid: list[Tensor] = field(default_factory=list)
    """Bool (N,), False where the row was frozen or its physics broke: such a transition teaches nothing."""
    elapsed: list[Tensor] = field(default_factory=list)
    """Steps since the row's episode began, before the step (N,)."""

    def add(self, **step: Tensor) -> None:
        """Takes a step, with every field by name."""
        for name, value in step.items():
            getattr(self, name).append(value)

    def __len__(self) -> int:
        return len(self.obs)

    def stacked(self, name: str) -> Tensor:
        """A field of all steps (T, N, ...)."""
        return torch.stack(getattr(self, name))

    def by_task(self, name: str, rows: TaskRows) -> Tensor:
        """A field of all steps by task (M, T * R, ...); rearranged step by step, so that nothing large is copied."""
        return torch.stack([rows.by_task(x) for x in getattr(self, name)], dim=1).flatten(1, 2)


@torch.no_grad()
def task_batch(stage: Stage, rows: TaskRows, log_std: Tensor, config: MetaConfig) -> TaskBatch:
    """The batch that tasks adapt on.

    Returns count to the end of the stage and no further: what an episode that is longer than it would still earn is not
    estimated, since a baseline fitted to these very returns knows nothing beyond.

    Args:
        stage: What was sampled.
        rows: Which rows play the same task.
        log_std: Logarithms of the standard deviations of the policies that sampled (M, a).
        config: Discount, trace, scale.
    """
    rewards, terminated, ended, valid = (stage.stacked(n) for n in ("rewards", "terminated", "ended", "valid"))
    obs, elapsed = stage.by_task("obs", rows), stage.by_task("elapsed", rows)
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
        obs=obs,
        actions=stage.by_task("actions", rows),
        old_means=stage.by_task("means", rows),
        old_log_stds=log_std.detach(),
        advantages=rows.steps_by_task(scaled),
        weights=weights,
    )


class Outcome(NamedTuple):
    """What a stage came to."""

    earned: Tensor
    """Undiscounted, unscaled return of each row (N,)."""
    success: Tensor
    """Whether each row succeeded, bool (N,)."""
    steps: Tensor
    """Environment steps, int64 (); a row that waits for the others takes none."""


def moments(x: Tensor, counted: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, variance and count of each column of (N, d), over the rows of a mask (N,)."""
    count = counted.sum()
    x = x.masked_fill(~counted[:, None], 0.0)
    mean = x.sum(0) / count.clamp_min(1)
    var = ((x - mean).square() * counted[:, None]).sum(0) / count.clamp_min(1)
    return mean, var, count

"""Generalised advantage estimation and statistics per task, as plain functions of (steps, rows) tensors."""

import torch
from torch import Tensor

from bidex_meta.training.distributed import pool_moments
from bidex_meta.world.contract import VectorWorld


def discounts(world: VectorWorld, gamma: float, task_id: Tensor) -> float | Tensor:
    """Return the discount of each entry of ``task_id`` (n,), or only ``gamma`` if no class has its own discount.

    A class without its own discount has the discount ``gamma``.
    """
    if all(own is None for own in world.gammas):
        return gamma
    return torch.tensor([gamma if own is None else own for own in world.gammas], device=task_id.device)[task_id]


def successor_values(values: Tensor, last_values: Tensor, ended: Tensor, final_values: Tensor) -> Tensor:
    """Return V (T, N) of the state that each transition led to, for worlds that reset within the step.

    ``last_values`` (N,) are the values of the states after the last step; ``final_values`` (T, N) are the values of the
    states in which episodes ``ended``.
    """
    following = torch.cat([values[1:], last_values[None]])
    return torch.where(ended, final_values, following)


def gae(
    rewards: Tensor, values: Tensor, next_values: Tensor, terminated: Tensor, ended: Tensor, gamma: float | Tensor,
    lam: float, valid: Tensor | None = None
) -> Tensor:  # fmt: skip
    """Compute advantages A_t = sum_k (gamma lam)^k delta_{t+k} within each episode.

    Here delta_t = r_t + gamma V(s'_t) - V(s_t). All tensors are (T, N). ``next_values`` are the values of the true
    successors (:func:`successor_values`) and count as 0 if ``terminated``; a time limit is not a termination. ``gamma``
    is a number or a tensor, (N,) or (T, N). Nothing propagates through entries that are not ``valid``.
    """
    delta = rewards + gamma * next_values.masked_fill(terminated, 0.0) - values
    keep = gamma * lam * (~ended).to(delta.dtype)
    advantages = torch.empty_like(delta)
    running = torch.zeros_like(delta[0])
    for t in range(delta.shape[0] - 1, -1, -1):
        running = delta[t] + keep[t] * running
        if valid is not None:
            running = running.masked_fill(~valid[t], 0.0)
        advantages[t] = running
    return advantages


def task_moments(x: Tensor, task_id: Tensor, num_tasks: int, valid: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean, biased variance and count (num_tasks,) of the valid entries of x (T, N), over all processes.

    All three are 0 for a task without valid entries.
    """

    def total(values: Tensor) -> Tensor:
        sums = torch.zeros(num_tasks, dtype=values.dtype, device=values.device)
        return sums.index_add_(0, task_id, values.masked_fill(~valid, 0.0).sum(0))

    count = total(torch.ones_like(x))
    mean = total(x) / count.clamp_min(1.0)
    var = total((x - mean[task_id]).square()) / count.clamp_min(1.0)
    return pool_moments(mean, var, count)


def normalise_per_task(x: Tensor, task_id: Tensor, num_tasks: int, valid: Tensor) -> Tensor:
    """Scale ``x`` (T, N) to zero mean and unit variance within each task; invalid entries become 0."""
    mean, var, _ = task_moments(x, task_id, num_tasks, valid)
    return ((x - mean[task_id]) / (var.sqrt()[task_id] + 1e-8)).masked_fill(~valid, 0.0)


def explained_variance(values: Tensor, returns: Tensor, task_id: Tensor, num_tasks: int, valid: Tensor) -> Tensor:
    """Return 1 - Var(return - value) / Var(return) per task (num_tasks,).

    Perfect values give 1. Values that predict no better than a constant give 0.
    """
    _, rest, _ = task_moments(returns - values, task_id, num_tasks, valid)
    _, whole, _ = task_moments(returns, task_id, num_tasks, valid)
    return 1.0 - rest / whole.clamp_min(1e-12)

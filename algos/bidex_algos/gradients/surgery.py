"""Gradient surgery: what to do where tasks pull shared weights apart."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn


def per_task_gradients(losses: Tensor, parameters: Sequence[nn.Parameter]) -> Tensor:
    """Gradients (num_tasks, P) of losses (num_tasks,), all parameters flattened; the graph is kept."""
    one_each = torch.eye(len(losses), dtype=losses.dtype, device=losses.device)
    gradients = torch.autograd.grad(losses, parameters, one_each, retain_graph=True, is_grads_batched=True)
    return torch.cat([g.flatten(1) for g in gradients], dim=1)


def project_conflicting(gradients: Tensor) -> tuple[Tensor, Tensor]:
    """PCGrad (Yu et al. 2020, algorithm 1): each gradient loses what points against another task's.

    The others are met in cyclic order instead of a random one, so that all processes of a run do the same.

    Args:
        gradients: One a task, (num_tasks, P).

    Returns:
        The sum of what is left of them, (P,); the share of pairs of tasks whose gradients point apart, a scalar.
    """
    count = len(gradients)
    gram = gradients @ gradients.T
    square = gram.diagonal().clamp_min(1e-30)
    # What is left of a gradient is a combination of all: row i holds the coefficients of the i-th, and all rows take a
    # step at once.
    combination = torch.eye(count, dtype=gradients.dtype, device=gradients.device)
    for shift in range(1, count):
        other = torch.arange(count, device=gradients.device).roll(-shift)
        overlap = (combination * gram[other]).sum(1).clamp_max(0.0)
        combination.scatter_add_(1, other[:, None], -(overlap / square[other])[:, None])
    apart = (gram < 0).sum() / max(count * (count - 1), 1)
    return combination.sum(0) @ gradients, apart

"""CAGrad: the direction near the mean gradient that serves the worst-served task best (Liu et al. 2021)."""

import torch
from torch import Tensor

STEPS = 24
"""Of the dual's solution; the last one's mu is 1e-8 of the mean gradient's square."""


def conflict_averse(gradients: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """The sum of all gradients, turned towards those that it serves worst.

    With g_0 the mean of the gradients, it is the number of tasks times the d that maximises min_i <g_i, d> among those
    within ``radius`` |g_0| of g_0. Its dual (their equation 4) is over weights w on the simplex, g_w = sum_i w_i g_i::

        min_w  <g_w, g_0> + radius |g_0| |g_w|        d = g_0 + radius |g_0| g_w / |g_w|

    Args:
        gradients: One a task, (num_tasks, P).
        radius: Their c, from 0 (the mean) on; below 1, so that the mean loss still falls.

    Returns:
        The direction, (P,); the share of pairs of tasks whose gradients point apart, a scalar.
    """
    count = len(gradients)
    gram = (gradients @ gradients.T).double()
    even = torch.full((count,), 1.0 / count, dtype=gram.dtype, device=gram.device)
    reach = radius * (even @ gram @ even).clamp_min(0.0).sqrt()
    weights = worst_served(gram, even, reach)
    length = (weights @ gram @ weights).clamp_min(1e-30).sqrt()
    combination = count * (even + reach / length * weights)
    apart = (gram < 0).sum() / max(count * (count - 1), 1)
    return combination.to(gradients.dtype) @ gradients, apart.to(gradients.dtype)


def worst_served(gram: Tensor, even: Tensor, reach: Tensor) -> Tensor:
    """The weights w (n,) on the simplex that minimise w'G e + reach sqrt(w'G w), to 1e-4 of e'G e.

    An interior-point method: the weights' logarithms, times a mu that is halved at each step, keep them positive, and
    a cone of the same mu rounds off the tip where w'G w is 0, at which a descent along w would get stuck. Each step is
    Newton's, as long as is best of some lengths. It looks at no number, so that a GPU need not be waited for.

    Args:
        gram: Products of the gradients (n, n), float64.
        even: The weights e of the mean (n,), where it starts.
        reach: A scalar.
    """
    weights, mean, square = even, gram @ even, reach.square()
    lengths = 0.7 ** torch.arange(15, dtype=gram.dtype, device=gram.device)[:, None]
    mu = 0.1 * (even @ mean).clamp_min(1e-30)
    diagonal = torch.eye(len(even), dtype=gram.dtype, device=gram.device)
    for _ in range(STEPS):
        own = gram @ weights
        root = (mu.square() + square * (weights @ own).clamp_min(0.0)).sqrt()
        pull = square / (mu + root)
        curved = pull * (gram - pull / root * own.outer(own))
        # In shares of the weights, so that small ones do not spoil the condition.
        matrix = weights.outer(weights) * curved + mu * diagonal
        sides = torch.stack([mu - weights * (mean + pull * own), weights], dim=1)
        newton, constant = torch.linalg.solve_ex(matrix, sides)[0].unbind(1)
        way = newton - (weights @ newton) / (weights @ constant) * constant
        tried = weights * (1.0 + lengths * way * (0.95 / (-way).amax().clamp_min(0.95)))
        root = (mu.square() + square * ((tried @ gram) * tried).sum(1).clamp_min(0.0)).sqrt()
        value = tried @ mean + root - mu * ((mu + root).log() + tried.log().sum(1))
        weights = tried.index_select(0, value.argmin(keepdim=True)).squeeze(0)
        mu = 0.5 * mu
    return weights

"""CAGrad: the direction near the mean gradient that serves the worst-served task best (Liu et al. 2021)."""

import torch
from torch import Tensor


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
    """The weights w (n,) on the simplex that minimise w'G e + reach sqrt(w'G w), as far as 4 n steps lead.

    A step moves weight between the two tasks where that falls most steeply, and exactly as much as is best: of two
    tasks the first is the solution. It looks at no number, so that a GPU need not be waited for.

    Args:
        gram: Products of the gradients (n, n), float64.
        even: The weights e of the mean (n,), where it starts.
        reach: A scalar.
    """
    weights, mean = even, gram @ even
    identity = torch.eye(len(even), dtype=gram.dtype, device=gram.device)
    for _ in range(4 * len(even) if len(even) > 2 else len(even) - 1):
        own = gram @ weights
        slope = mean + reach * own / (weights @ own).clamp_min(1e-30).sqrt()
        gains = slope.argmin(keepdim=True)
        loses = slope.masked_fill(weights <= 0.0, -torch.inf).argmax(keepdim=True)
        way = (identity.index_select(0, gains) - identity.index_select(0, loses)).squeeze(0)
        room = weights.index_select(0, loses).squeeze(0)
        weights = weights + _best_step(way @ mean, way @ gram @ way, way @ own, weights @ own, reach, room) * way
    return weights


def _best_step(linear: Tensor, square: Tensor, product: Tensor, own: Tensor, reach: Tensor, room: Tensor) -> Tensor:
    """Where linear t + reach sqrt(square t^2 + 2 product t + own) is least for t in [0, room]; scalars."""
    square = square.clamp_min(1e-30)
    rest = (own / square - (product / square).square()).clamp_min(0.0)
    margin = reach.square() * square - linear.square()
    # Without a margin the straight part wins: as far as it goes, downhill.
    inner = -linear * (rest / margin.clamp_min(1e-30)).sqrt() - product / square
    return torch.where(margin > 0.0, inner, -torch.inf * linear.sign()).nan_to_num(0.0).clamp_min(0.0).minimum(room)

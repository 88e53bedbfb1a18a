"""A value function that is linear in features of observation and time, fitted anew to each task and batch.

A network would need more data than one adaptation batch has (Duan et al. 2016, section 5; ProMP and Meta-World use the
same family).
"""

import torch
from torch import Tensor

_BOUND = 10.0


def features(obs: Tensor, elapsed: Tensor) -> Tensor:
    """Observation, its square, three powers of time, and 1.

    Args:
        obs: Normalised observations (..., d).
        elapsed: Steps since the episode began (...).

    Returns:
        (..., 2 d + 4), float32.
    """
    bounded = obs.clamp(-_BOUND, _BOUND)
    t = elapsed[..., None].to(obs.dtype) / 100.0
    return torch.cat([bounded, bounded.square(), t, t.square(), t**3, torch.ones_like(t)], dim=-1)


def fitted(x: Tensor, returns: Tensor, weights: Tensor, ridge: float = 1e-5) -> Tensor:
    """Predictions of the returns they are fitted to, by ridge regression in each task.

    Args:
        x: Features (tasks, B, f).
        returns: What to predict (tasks, B).
        weights: 1, or 0 for what does not count (tasks, B).
        ridge: Added to the diagonal, relative to its mean.

    Returns:
        (tasks, B), in the type of ``returns``.
    """
    predicted = [_one(*task, ridge) for task in zip(x, returns, weights, strict=True)]
    return torch.stack(predicted).to(returns.dtype)


def _one(x: Tensor, returns: Tensor, weights: Tensor, ridge: float) -> Tensor:
    # Task by task, since all Gram matrices at once take more memory and no less time.
    weighted = x * weights[:, None]
    gram = (weighted.T @ x).double()
    diagonal = gram.diagonal()
    diagonal += ridge * diagonal.mean().clamp_min(1.0)
    coefficients = torch.linalg.solve(gram, (weighted.T @ returns).double())
    return x.double() @ coefficients

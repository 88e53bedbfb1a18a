"""FAMO: weights of tasks under which all losses fall at the same rate, without a gradient for each (Liu et al. 2023).

    z = softmax(xi)
    theta  down on  sum_i (z_i / l_i) l_i' / sum_j (z_j / l_j)        that is the mean of log l_i, weighted by z
    xi     down on  J'(log l - log l after the step), J = dz / dxi    the slower a loss falls, the more it weighs

Losses have to be positive: what counts is how far each is above the least that it can become (``min_losses`` of the
authors' code). xi is moved by Adam with a decay towards even weights, as there.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

_LEAST = 1e-8


class Famo:
    """The weights and what moves them.

    Args:
        num_tasks: How many tasks.
        rate: Adam's step size of xi.
        decay: By which xi is drawn to zero.
        device: Of the losses.

    Attributes:
        logits: xi (num_tasks,), float64, in checkpoints.
    """

    def __init__(self, num_tasks: int, rate: float, decay: float, device: torch.device):
        self.logits = nn.Parameter(torch.zeros(num_tasks, device=device, dtype=torch.float64))
        self.adam = torch.optim.Adam([self.logits], lr=rate, weight_decay=decay, fused=True)
        self.above = torch.zeros_like(self.logits)

    def weights(self, above: Tensor) -> Tensor:
        """Factors of the losses (num_tasks,), 1 in the mean; 0 for a task whose loss cannot fall.

        Args:
            above: How far each loss is above its least (num_tasks,); kept until :meth:`learn`.
        """
        self.above = above.detach().double()
        shares = self.logits.detach().softmax(0) / self.above.clamp_min(_LEAST)
        shares = shares.masked_fill(self.above <= _LEAST, 0.0)
        return (len(shares) * shares / shares.sum().clamp_min(1e-30)).to(above.dtype)

    @torch.no_grad()
    def learn(self, above: Callable[[], Tensor]) -> None:
        """Moves the weights by what the step has done; ``above`` gives the same losses after it."""
        fallen = self.above.clamp_min(_LEAST).log() - above().double().clamp_min(_LEAST).log()
        fallen = fallen.masked_fill(self.above <= _LEAST, 0.0)
        z = self.logits.softmax(0)
        self.logits.grad = z * (fallen - (z * fallen).sum())
        self.adam.step()

    def parts(self) -> dict[str, Any]:
        """What a checkpoint holds of it."""
        return {"famo_logits": self.logits, "famo_adam": self.adam}

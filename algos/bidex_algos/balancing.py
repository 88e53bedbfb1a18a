"""How the losses of several tasks become one gradient of the weights that they share: one interface, a few ways."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn
from typing_extensions import override

from bidex_meta.training.distributed import all_sum, world_size
from bidex_meta.training.learner import Parts

Balancing = Literal["none", "pcgrad", "cagrad", "famo"]


class Balance(ABC):
    """Puts one gradient in the place of the sum of all tasks' losses."""

    tag: ClassVar[str]  # of the number that it reports

    @abstractmethod
    def backward(self, losses: Tensor, least: Tensor, parameters: Sequence[nn.Parameter]) -> Tensor:
        """Puts the gradient into the parameters, which have none yet, and keeps the graph.

        ``losses`` of each task, and the ``least`` they can become, are this process's part (num_tasks,). Returns a
        number to be logged, divided by the processes that will sum it, as they will the gradients.
        """

    def learn(self, above: Callable[[], Tensor]) -> None:  # noqa: B027
        """What follows a step; ``above`` tells how far each loss is above its least now, this process's part."""

    def parts(self) -> Parts:
        """What a checkpoint holds of it, by name."""
        return {}


def per_task_gradients(losses: Tensor, parameters: Sequence[nn.Parameter]) -> Tensor:
    """Gradients (num_tasks, P) of losses (num_tasks,), all parameters flattened; the graph is kept."""
    one_each = torch.eye(len(losses), dtype=losses.dtype, device=losses.device)
    gradients = torch.autograd.grad(losses, parameters, one_each, retain_graph=True, is_grads_batched=True)
    return torch.cat([g.flatten(1) for g in gradients], dim=1)


def project_conflicting(gradients: Tensor) -> tuple[Tensor, Tensor]:
    """PCGrad (Yu et al. 2020, algorithm 1): each gradient loses what points against another task's.

    The others are met in cyclic order instead of a random one, so that all processes of a run do the same.
    Returns the sum (P,) of what is left of ``gradients`` (num_tasks, P), and the share of pairs in conflict, a scalar.
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


def conflict_averse(gradients: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """CAGrad (Liu et al. 2021): the sum of all gradients, turned towards those that it serves worst.

    With g_0 the mean of the gradients, it is the number of tasks times the d that maximises min_i <g_i, d> among those
    within ``radius`` |g_0| of g_0. Its dual (their equation 4) is over weights w on the simplex, g_w = sum_i w_i g_i::

        min_w  <g_w, g_0> + radius |g_0| |g_w|        d = g_0 + radius |g_0| g_w / |g_w|

    ``gradients``: one a task, (num_tasks, P); ``radius``: their c, from 0 (the mean) on; below 1, so that the mean loss
    still falls. Returns the direction, (P,); the share of pairs of tasks whose gradients point apart, a scalar.
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

    An interior-point method: logarithms of the weights, times a mu that is halved at each step, keep them positive, and
    a cone of the same mu rounds off the tip where w'G w is 0. Each step is Newton's, as long as is best of some
    lengths. It looks at no number, so that a GPU need not be waited for. ``gram``: products of the gradients (n, n),
    float64; ``even``: the weights e of the mean (n,), where it starts.
    """
    weights, mean, square = even, gram @ even, reach.square()
    lengths = 0.7 ** torch.arange(15, dtype=gram.dtype, device=gram.device)[:, None]
    mu = 0.1 * (even @ mean).clamp_min(1e-30)
    diagonal = torch.eye(len(even), dtype=gram.dtype, device=gram.device)
    for _ in range(24):  # the last mu is 1e-8 of the mean gradient's square
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


class GradientBalance(Balance):
    """Combines the tasks' gradients (num_tasks, P) to one (P,) and a share of conflicts; a backward pass for each."""

    tag = "Policy/conflicts"

    def __init__(self, combine: Callable[[Tensor], tuple[Tensor, Tensor]]):
        self.combine = combine

    @override
    def backward(self, losses: Tensor, least: Tensor, parameters: Sequence[nn.Parameter]) -> Tensor:
        gradient, apart = self.combine(all_sum(per_task_gradients(losses, parameters)))
        for parameter, part in zip(parameters, gradient.split([p.numel() for p in parameters]), strict=True):
            # All processes have the whole of it, and sum it.
            parameter.grad = part.view_as(parameter) / world_size()
        return apart / world_size()


_LEAST = 1e-8


class Famo(Balance):
    """FAMO (Liu et al. 2023): weights of tasks under which all losses fall at the same rate, without a gradient each.

    theta goes down on sum_i (z_i / l_i) l_i' / sum_j (z_j / l_j), z = softmax(xi); xi down on J'(log l - log l after
    the step), J = dz / dxi. Losses have to be positive: what counts is how far each is above the least that it can
    become. Adam, of step size ``rate``, moves xi (``logits``, float64) with a ``decay`` towards even weights.
    """

    tag = "Policy/largest_weight"

    def __init__(self, num_tasks: int, rate: float, decay: float, device: torch.device):
        self.logits = nn.Parameter(torch.zeros(num_tasks, device=device, dtype=torch.float64))
        self.adam = torch.optim.Adam([self.logits], lr=rate, weight_decay=decay, fused=True)
        self.above = torch.zeros_like(self.logits)

    def weights(self, above: Tensor) -> Tensor:
        """Factors of losses (num_tasks,) so far above their least, 1 in the mean; 0 for one that cannot fall."""
        self.above = above.detach().double()
        shares = self.logits.detach().softmax(0) / self.above.clamp_min(_LEAST)
        shares = shares.masked_fill(self.above <= _LEAST, 0.0)
        return (len(shares) * shares / shares.sum().clamp_min(1e-30)).to(above.dtype)

    def backward(self, losses: Tensor, least: Tensor, parameters: Sequence[nn.Parameter]) -> Tensor:
        """As in the base; the number is the largest weight."""
        weights = self.weights(all_sum((losses - least).detach()))
        (weights * losses).sum().backward(retain_graph=True)
        return weights.max() / len(weights) / world_size()

    @torch.no_grad()
    def learn(self, above: Callable[[], Tensor]) -> None:
        """As in the base: costs another forward pass."""
        fallen = self.above.clamp_min(_LEAST).log() - all_sum(above()).double().clamp_min(_LEAST).log()
        fallen = fallen.masked_fill(self.above <= _LEAST, 0.0)
        z = self.logits.softmax(0)
        self.logits.grad = z * (fallen - (z * fallen).sum())
        self.adam.step()

    def parts(self) -> Parts:
        """What a checkpoint holds of it."""
        return {"famo_logits": self.logits, "famo_adam": self.adam}

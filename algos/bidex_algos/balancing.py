"""Methods that combine the losses of several tasks into one gradient of their shared weights, behind one interface."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn
from typing_extensions import override

from bidex_meta.training.distributed import all_sum, world_size
from bidex_meta.training.learner import Parts

Balancing = Literal["none", "pcgrad", "cagrad", "famo"]
_CAGRAD_RADIUS = 0.4  # largest distance of cagrad's direction from the mean gradient, relative to its length
_FAMO_RATE = 0.025  # Adam's step size for famo's weights
_FAMO_DECAY = 0.01  # Adam's weight decay, which draws famo's weights back to equal ones


class Balance(ABC):
    """Interface of methods that combine the gradients of several tasks' losses in another way than by adding them."""

    tag: ClassVar[str]  # metric tag of the number that ``backward`` returns

    @abstractmethod
    def backward(self, losses: Tensor, least: Tensor, parameters: Sequence[nn.Parameter]) -> Tensor:
        """Compute the combined gradient of the tasks' losses and store it as the gradient of ``parameters``.

        The parameters must not have a gradient yet. The graph of the losses is kept. ``losses`` (num_tasks,) is this
        process's part of each task's loss. ``least`` (num_tasks,) is this process's part of the smallest value that
        each loss can reach. Returns a scalar to be logged. The scalar is already divided by the number of processes,
        because the caller sums it over the processes, as it sums the gradients.
        """

    def learn(self, above: Callable[[], Tensor]) -> None:  # noqa: B027
        """Adapt the method's own state, such as task weights, after the optimiser has taken a step.

        ``above`` is a function that computes this process's part of each loss minus the smallest value of that loss,
        (num_tasks,), with the new parameters.
        """

    def parts(self) -> Parts:
        """Return the tensors and optimisers of this method that a checkpoint stores, by name."""
        return {}


def per_task_gradients(losses: Tensor, parameters: Sequence[nn.Parameter]) -> Tensor:
    """Return the gradient of each of the losses (num_tasks,) with respect to all parameters: (num_tasks, P).

    P is the total number of entries of ``parameters``, which are flattened. The graph of the losses is kept for another
    backward pass.
    """
    one_each = torch.eye(len(losses), dtype=losses.dtype, device=losses.device)
    gradients = torch.autograd.grad(losses, parameters, one_each, retain_graph=True, is_grads_batched=True)
    return torch.cat([g.flatten(1) for g in gradients], dim=1)


def project_conflicting(gradients: Tensor) -> tuple[Tensor, Tensor]:
    """Remove from each task's gradient the components that point against other tasks' gradients.

    This is PCGrad (Yu et al. 2020, algorithm 1), but the other tasks are visited in cyclic instead of random order, so
    that all processes of a run compute the same result. Returns the sum (P,) of the projected ``gradients``
    (num_tasks, P) and the share of pairs of tasks whose gradients conflict, a scalar.
    """
    count = len(gradients)
    gram = gradients @ gradients.T
    square = gram.diagonal().clamp_min(1e-30)
    # A projected gradient is a combination of all gradients: row i holds the coefficients of the i-th, and all rows
    # take a step at once.
    combination = torch.eye(count, dtype=gradients.dtype, device=gradients.device)
    for shift in range(1, count):
        other = torch.arange(count, device=gradients.device).roll(-shift)
        overlap = (combination * gram[other]).sum(1).clamp_max(0.0)
        combination.scatter_add_(1, other[:, None], -(overlap / square[other])[:, None])
    apart = (gram < 0).sum() / max(count * (count - 1), 1)
    return combination.sum(0) @ gradients, apart


def conflict_averse(gradients: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Return a gradient that favours the tasks whose losses would otherwise fall least (CAGrad, Liu et al. 2021).

    Let g_0 be the mean of the gradients. The result is the number of tasks times the vector d that maximises
    min_i <g_i, d> within a distance of ``radius`` |g_0| from g_0. The dual problem (equation 4 of the paper) minimises
    over weights w on the simplex, with g_w = sum_i w_i g_i::

        min_w  <g_w, g_0> + radius |g_0| |g_w|        d = g_0 + radius |g_0| g_w / |g_w|

    ``gradients`` (num_tasks, P) has one row per task. ``radius`` is the paper's c: 0 gives the mean; a value below 1
    ensures that the mean loss still falls. Returns two values: the resulting gradient (P,), and the share of pairs of
    tasks whose gradients conflict, a scalar.
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
    """Return the task weights w (n,) that solve the dual problem of CAGrad (see :func:`conflict_averse`).

    The weights minimise w'G e + reach sqrt(w'G w) on the simplex. The value of the minimum is exact up to 1e-4 of
    e'G e, also if the mean is only a hundredth of the gradients. ``gram`` (n, n) is G, the inner products of the
    gradients, float64. ``even`` (n,) is e, the equal weights of the mean gradient; the method starts from these
    weights. ``reach`` is a scalar.

    This is an interior-point method. A logarithmic barrier with factor mu keeps the weights positive, and mu falls
    at each step. The same mu smooths the square root near w'G w = 0. Each step is a Newton step that tries several
    lengths and takes the best one. No number is read on the host, so the host never waits for a GPU.
    """
    weights = even
    mean = gram @ even
    square = reach.square()
    lengths = 0.7 ** torch.arange(15, dtype=gram.dtype, device=gram.device)[:, None]
    mu = 0.1 * (even @ mean).clamp_min(1e-30)
    diagonal = torch.eye(len(even), dtype=gram.dtype, device=gram.device)
    # 48 steps end at a mu of 1e-8 of the mean gradient's square. Larger steps fail if the mean is small: with 24
    # halvings, the error was 40 times that square for a mean of a hundredth of the gradients.
    for _ in range(48):
        own = gram @ weights
        root = (mu.square() + square * (weights @ own).clamp_min(0.0)).sqrt()
        pull = square / (mu + root)
        curved = pull * (gram - pull / root * own.outer(own))
        # The variables are relative changes of the weights, so that small weights do not spoil the condition number.
        matrix = weights.outer(weights) * curved + mu * diagonal
        sides = torch.stack([mu - weights * (mean + pull * own), weights], dim=1)
        newton, constant = torch.linalg.solve_ex(matrix, sides)[0].unbind(1)
        way = newton - (weights @ newton) / (weights @ constant) * constant
        tried = weights * (1.0 + lengths * way * (0.95 / (-way).amax().clamp_min(0.95)))
        root = (mu.square() + square * ((tried @ gram) * tried).sum(1).clamp_min(0.0)).sqrt()
        value = tried @ mean + root - mu * ((mu + root).log() + tried.log().sum(1))
        weights = tried.index_select(0, value.argmin(keepdim=True)).squeeze(0)
        mu = 0.5**0.5 * mu
    return weights


class GradientBalance(Balance):
    """Combines the tasks' gradients (num_tasks, P) into one gradient (P,), with one backward pass per task.

    Besides the gradient, ``combine`` returns the share of conflicting pairs of gradients, which is logged.
    """

    tag = "Policy/conflicts"

    def __init__(self, combine: Callable[[Tensor], tuple[Tensor, Tensor]]):
        self.combine = combine

    @override
    def backward(self, losses: Tensor, least: Tensor, parameters: Sequence[nn.Parameter]) -> Tensor:
        gradient, apart = self.combine(all_sum(per_task_gradients(losses, parameters)))
        for parameter, part in zip(parameters, gradient.split([p.numel() for p in parameters]), strict=True):
            # Every process holds the whole gradient, and the processes sum it.
            parameter.grad = part.view_as(parameter) / world_size()
        return apart / world_size()


_LEAST = 1e-8


class Famo(Balance):
    """FAMO (Liu et al. 2023): weights the tasks' losses so that all of them fall at the same rate.

    FAMO needs no separate gradient per task. Let l_i be the loss of task i minus the smallest value that this loss can
    reach, so that l_i is not negative. The parameters descend along sum_i (z_i / l_i) grad l_i / sum_j (z_j / l_j),
    with z = softmax(xi). The logits xi descend along J^T (log l before the step - log l after the step), with
    J = dz / dxi. Adam moves xi (``logits``, float64) with step size ``rate``. Adam's weight decay ``decay`` pulls the
    logits towards 0, and so the task weights z towards equal values.
    """

    tag = "Policy/largest_weight"

    def __init__(self, num_tasks: int, rate: float, decay: float, device: torch.device):
        self.logits = nn.Parameter(torch.zeros(num_tasks, device=device, dtype=torch.float64))
        self.adam = torch.optim.Adam([self.logits], lr=rate, weight_decay=decay, fused=True)
        self.above = torch.zeros_like(self.logits)

    def weights(self, above: Tensor) -> Tensor:
        """Return the factor of each loss (num_tasks,): 1 on average, 0 for a loss that cannot fall any further.

        ``above`` (num_tasks,) is each loss minus the smallest value that it can reach.
        """
        self.above = above.detach().double()
        shares = self.logits.detach().softmax(0) / self.above.clamp_min(_LEAST)
        shares = shares.masked_fill(self.above <= _LEAST, 0.0)
        return (len(shares) * shares / shares.sum().clamp_min(1e-30)).to(above.dtype)

    def backward(self, losses: Tensor, least: Tensor, parameters: Sequence[nn.Parameter]) -> Tensor:
        """Store the gradient of the weighted losses, and return the largest weight as a share of the sum of weights.

        The arguments are described in the base class. The returned number is divided by the number of processes.
        """
        weights = self.weights(all_sum((losses - least).detach()))
        (weights * losses).sum().backward(retain_graph=True)
        return weights.max() / len(weights) / world_size()

    @torch.no_grad()
    def learn(self, above: Callable[[], Tensor]) -> None:
        """Adapt the logits of the task weights to how much each loss has fallen in the last step.

        ``above`` is described in the base class. Calling it takes another forward pass.
        """
        fallen = self.above.clamp_min(_LEAST).log() - all_sum(above()).double().clamp_min(_LEAST).log()
        fallen = fallen.masked_fill(self.above <= _LEAST, 0.0)
        z = self.logits.softmax(0)
        self.logits.grad = z * (fallen - (z * fallen).sum())
        self.adam.step()

    def parts(self) -> Parts:
        """Return the logits of the task weights and their optimiser, which a checkpoint stores, by name."""
        return {"famo_logits": self.logits, "famo_adam": self.adam}


def balance_of(name: Balancing, num_tasks: int, device: torch.device) -> Balance | None:
    """Return the balancing method called ``name``; for ``none`` return None, which means that the losses are summed."""
    if name == "pcgrad":
        return GradientBalance(project_conflicting)
    if name == "cagrad":
        return GradientBalance(partial(conflict_averse, radius=_CAGRAD_RADIUS))
    if name == "famo":
        return Famo(num_tasks, _FAMO_RATE, _FAMO_DECAY, device)
    return None

"""A step within a KL bound: conjugate gradients, Fisher-vector products and line search, on flat vectors."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from bidex_meta.training.distributed import all_sum

Product = Callable[[Tensor], Tensor]  # A symmetric positive matrix as a function that multiplies it with a vector (P,)


def flatten(tensors: Sequence[Tensor]) -> Tensor:
    """Concatenate all entries into one vector (P,)."""
    return torch.cat([t.reshape(-1) for t in tensors])


@torch.no_grad()
def write(parameters: Sequence[nn.Parameter], vector: Tensor) -> None:
    """Overwrite parameters with the entries of a vector (P,)."""
    for parameter, part in zip(parameters, vector.split([p.numel() for p in parameters]), strict=True):
        parameter.copy_(part.view_as(parameter))


def conjugate_gradient(product: Product, b: Tensor, iterations: int, tolerance: float = 1e-10) -> Tensor:
    """Solve ``product(x) = b`` for x (P,), starting at 0 (Hestenes and Stiefel 1952).

    After P iterations the solution is exact except for rounding. Once the squared residual is below ``tolerance`` times
    the initial squared residual, x no longer changes.
    """
    x = torch.zeros_like(b)
    residual = b.clone()
    direction = b.clone()
    square = first = residual.dot(residual)
    for _ in range(iterations):
        along = product(direction)
        # The update is masked instead of stopped, because a stop would require a host sync.
        going = square > tolerance * first
        length = torch.where(going, square / direction.dot(along), 0.0)
        x = x + length * direction
        residual = residual - length * along
        following = residual.dot(residual)
        direction = residual + torch.where(going, following / square, 0.0) * direction
        square = following
    return x


def fisher_product(kl: Tensor, parameters: Sequence[nn.Parameter], damping: float) -> Product:
    """Return Fisher-vector products F v + damping v, computed by differentiating the KL twice.

    ``kl`` is the mean KL between the policy and a constant copy of it (this process's part), with its graph. The
    Hessian of ``kl`` is the Fisher matrix F.
    """
    slope = flatten(torch.autograd.grad(kl, parameters, create_graph=True))

    def product(v: Tensor) -> Tensor:
        curved = torch.autograd.grad(slope.dot(v), parameters, retain_graph=True)
        return all_sum(flatten(curved)) + damping * v

    return product


def line_search(
    parameters: Sequence[nn.Parameter], step: Tensor, measure: Callable[[], tuple[float, float]], *, expected: float,
    max_kl: float, accept_ratio: float, factor: float, tries: int
) -> float:  # fmt: skip
    """Shorten ``step`` (P,) until the objective has risen and the KL is within its bound; otherwise change nothing.

    ``measure`` returns objective and KL. ``expected`` is the rise that the whole step should bring. A shortened step
    must bring at least ``accept_ratio`` of its share of this rise. Returns the share of the step that was taken, or 0.
    """
    start = flatten(parameters).detach().clone()
    before, _ = measure()
    share = 1.0
    for _ in range(tries):
        write(parameters, start + share * step)
        objective, kl = measure()
        # Comparisons with NaN are false, so a broken point is never accepted.
        if objective - before > max(accept_ratio * share * expected, 0.0) and kl <= max_kl:
            return share
        share *= factor
    write(parameters, start)
    return 0.0


def trust_region_step(
    parameters: Sequence[nn.Parameter], objective: Tensor, kl: Tensor, measure: Callable[[], tuple[float, float]],
    config: Any, max_kl: float, kl_tag: str, accept_ratio: float = 0.0
) -> dict[str, Tensor]:  # fmt: skip
    """Take a step along F^-1 g, where F is the Fisher matrix and g the gradient of the objective.

    The step is as long as the KL ``max_kl`` allows to second order; then :func:`line_search` shortens it. Returns
    scalars to be logged. ``objective`` is this process's part of the value to raise, with its graph; ``kl`` is
    described in :func:`fisher_product`. The config has ``damping``, ``cg_iterations``, ``backtracks`` and
    ``backtrack_factor``.
    """
    gradient = all_sum(flatten(torch.autograd.grad(objective, parameters, retain_graph=True)))
    product = fisher_product(kl, parameters, config.damping)
    direction = conjugate_gradient(product, gradient, config.cg_iterations)
    curvature = direction.dot(product(direction)).clamp_min(1e-12)
    step = torch.sqrt(2.0 * max_kl / curvature) * direction
    share = line_search(
        parameters, step, measure, expected=float(gradient.dot(step)), max_kl=max_kl, accept_ratio=accept_ratio,
        factor=config.backtrack_factor, tries=config.backtracks
    )  # fmt: skip
    rise, moved = measure()
    found = {"Loss/surrogate": -rise, kl_tag: moved, "Policy/step_share": share}
    return {name: torch.tensor(value, device=gradient.device) for name, value in found.items()}

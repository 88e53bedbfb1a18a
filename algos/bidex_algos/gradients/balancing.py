"""How the losses of several tasks become one gradient of the weights that they share: one interface, a few ways."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from bidex_algos.gradients.conflict_averse import conflict_averse
from bidex_algos.gradients.famo import Famo
from bidex_algos.gradients.surgery import per_task_gradients, project_conflicting
from bidex_meta.train.distributed import all_sum, world_size


class Balance(ABC):
    """Puts one gradient in the place of the sum of all tasks' losses."""

    tag: ClassVar[str]
    """Name of the number that it tells, in the log."""

    @abstractmethod
    def backward(self, losses: Tensor, least: Tensor, parameters: Sequence[nn.Parameter]) -> Tensor:
        """Puts the gradient into the parameters, which have none yet, and keeps the graph.

        Args:
            losses: Of each task, this process's part (num_tasks,).
            least: What each could become at best, its part (num_tasks,).
            parameters: The shared weights.

        Returns:
            A number to be told, divided by the processes that will sum it, as they will the gradients.
        """

    def learn(self, above: Callable[[], Tensor]) -> None:  # noqa: B027
        """What follows a step; ``above`` tells how far each loss is above its least now, this process's part."""

    def parts(self) -> dict[str, Any]:
        """What a checkpoint holds of it, by name."""
        return {}


class GradientBalance(Balance):
    """Makes one gradient of the tasks' gradients; costs a backward pass for each.

    Args:
        combine: Gradients (num_tasks, P) to one (P,) and the share of pairs of tasks in conflict.
    """

    tag = "Policy/conflicts"

    def __init__(self, combine: Callable[[Tensor], tuple[Tensor, Tensor]]):
        self.combine = combine

    def backward(self, losses: Tensor, least: Tensor, parameters: Sequence[nn.Parameter]) -> Tensor:
        """As in the base."""
        gradient, apart = self.combine(all_sum(per_task_gradients(losses, parameters)))
        for parameter, part in zip(parameters, gradient.split([p.numel() for p in parameters]), strict=True):
            # All processes have the whole of it, and sum it.
            parameter.grad = part.view_as(parameter) / world_size()
        return apart / world_size()


class LossBalance(Balance):
    """Weighs the losses; costs another forward pass."""

    tag = "Policy/largest_weight"

    def __init__(self, famo: Famo):
        self.famo = famo

    def backward(self, losses: Tensor, least: Tensor, parameters: Sequence[nn.Parameter]) -> Tensor:
        """As in the base."""
        weights = self.famo.weights(all_sum((losses - least).detach()))
        (weights * losses).sum().backward(retain_graph=True)
        return weights.max() / len(weights) / world_size()

    def learn(self, above: Callable[[], Tensor]) -> None:
        """As in the base."""
        self.famo.learn(lambda: all_sum(above()))

    def parts(self) -> dict[str, Any]:
        """As in the base."""
        return self.famo.parts()


def balance_of(config: Any, num_tasks: int, device: torch.device) -> Balance | None:
    """What a config's ``gradient_surgery`` names; None: the losses are summed."""
    if config.gradient_surgery == "pcgrad":
        return GradientBalance(project_conflicting)
    if config.gradient_surgery == "cagrad":
        return GradientBalance(partial(conflict_averse, radius=config.cagrad_radius))
    if config.gradient_surgery == "famo":
        return LossBalance(Famo(num_tasks, config.famo_rate, config.famo_decay, device))
    return None

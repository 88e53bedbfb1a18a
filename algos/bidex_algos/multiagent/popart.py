"""PopArt (van Hasselt et al. 2016, Hessel et al. 2019): critics whose values outlast a change of their units."""

import torch
from torch import Tensor

from bidex_algos.nets.networks import MLP


@torch.no_grad()
def keep_values(critics: list[MLP], before: tuple[Tensor, Tensor], after: tuple[Tensor, Tensor]) -> None:
    """Moves the output layers of critics, so that std V + mean is as it was before mean and std changed.

    Args:
        critics: Each has an output for each task.
        before: Mean and standard deviation of the returns by which the critics' units were defined, each
            (critics * tasks,).
        after: The same of the new units.
    """
    given = [x.view(len(critics), -1) for x in (*before, *after)]
    for critic, old_mean, old_std, mean, std in zip(critics, *given, strict=True):
        weight, bias = critic.head.weight, critic.head.bias
        weight.copy_(weight * (old_std / std)[:, None])
        bias.copy_((old_std * bias + old_mean - mean) / std)

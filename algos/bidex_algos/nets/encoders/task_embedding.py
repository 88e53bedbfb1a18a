"""A learned vector for each task in the place of its one-hot."""

from functools import partial

import torch
from torch import Tensor, nn

from bidex_algos.nets.encoders.inputs import Inputs


class TaskEmbedding(nn.Module):
    """Maps the one-hot of a task (..., tasks) to the task's vector (..., size), at first drawn from N(0, 1).

    Args:
        tasks: Entries of the one-hot.
        generator: CPU generator of the initial vectors.
        size: Entries of a vector.
        unit: Whether it is shortened or stretched to length 1 when read.
    """

    def __init__(self, tasks: int, generator: torch.Generator, size: int, unit: bool = False):
        super().__init__()
        self.size, self.unit = size, unit
        self.vectors = nn.Parameter(torch.randn(tasks, size, generator=generator))

    def forward(self, one_hot: Tensor) -> Tensor:
        """The vectors of the tasks."""
        vectors = nn.functional.normalize(self.vectors, dim=1) if self.unit else self.vectors
        return one_hot @ vectors


def with_task_embedding(inputs: Inputs, size: int, unit: bool = False) -> Inputs:
    """The same with the task read by an embedding of so many entries, of length 1 if ``unit``; 0: as it was."""
    return inputs.encoded("task_id", partial(TaskEmbedding, size=size, unit=unit)) if size else inputs

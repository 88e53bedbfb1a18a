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
    """

    def __init__(self, tasks: int, generator: torch.Generator, size: int):
        super().__init__()
        self.size = size
        self.vectors = nn.Parameter(torch.randn(tasks, size, generator=generator))

    def forward(self, one_hot: Tensor) -> Tensor:
        """The vectors of the tasks."""
        return one_hot @ self.vectors


def with_task_embedding(inputs: Inputs, size: int) -> Inputs:
    """The same with the task read by an embedding of so many entries; 0: as it was."""
    return inputs.encoded("task_id", partial(TaskEmbedding, size=size)) if size else inputs

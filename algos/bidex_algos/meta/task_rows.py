"""Which rows of a world play the same task, and data rearranged by task."""

import torch
from torch import Tensor


class TaskRows:
    """Rows by task, as a rectangle: tasks with fewer rows than others repeat one, without weight.

    Args:
        task_of_row: Task of each row, numbers from 0 on without gaps, int64 (N,).

    Attributes:
        count: Number of tasks M.
        task_of_row: As given.
        weight: 1, or 0 where a row is repeated to fill the rectangle, (M, R) float32.
    """

    def __init__(self, task_of_row: Tensor):
        self.task_of_row = task_of_row
        self.count = int(task_of_row.max()) + 1
        counts = torch.bincount(task_of_row, minlength=self.count)
        width = int(counts.max())
        order = torch.argsort(task_of_row, stable=True)
        first = counts.cumsum(0) - counts
        column = torch.arange(width, device=task_of_row.device)
        self._table = order[first[:, None] + torch.minimum(column, counts[:, None] - 1)]
        self.weight = (column < counts[:, None]).float()
        # Where each row stands in the flattened rectangle.
        place = torch.empty_like(order)
        rank = torch.arange(len(order), device=order.device) - first[task_of_row[order]]
        place[order] = task_of_row[order] * width + rank
        self._place = place

    def by_task(self, x: Tensor) -> Tensor:
        """(N, ...) to (M, R, ...)."""
        return x[self._table]

    def by_row(self, x: Tensor) -> Tensor:
        """(M, R, ...) back to (N, ...)."""
        return x.flatten(0, 1)[self._place]

    def steps_by_task(self, x: Tensor) -> Tensor:
        """(T, N, ...) to (M, T * R, ...)."""
        return x[:, self._table].transpose(0, 1).flatten(1, 2)

    def steps_by_row(self, x: Tensor, steps: int) -> Tensor:
        """(M, T * R, ...) back to (T, N, ...)."""
        return x.unflatten(1, (steps, -1)).transpose(0, 1).flatten(1, 2)[:, self._place]

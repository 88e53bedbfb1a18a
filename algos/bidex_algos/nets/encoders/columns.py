"""Some columns of an observation, wherever they stand."""

from collections.abc import Iterable

import torch
from torch import Tensor, nn


class Columns(nn.Module):
    """Reads and writes some columns of tensors (..., d). It has no weights and leaves nothing in a checkpoint.

    Args:
        ranges: The columns; they are taken in ascending order.

    Attributes:
        size: How many they are.
    """

    def __init__(self, ranges: Iterable[slice]):
        super().__init__()
        index = sorted(column for part in ranges for column in range(part.start, part.stop))
        self.size = len(index)
        first = index[0] if index else 0
        # A slice is a view; columns with gaps have to be copied.
        self.range = slice(first, first + self.size) if index == list(range(first, first + self.size)) else None
        self.index: Tensor
        self.register_buffer("index", torch.tensor(index, dtype=torch.int64), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """The columns (..., size) of ``x`` (..., d); a view where they stand side by side."""
        return x.index_select(-1, self.index) if self.range is None else x[..., self.range]

    def write(self, x: Tensor, values: Tensor) -> None:
        """Puts ``values`` (..., size) into the columns of ``x`` (..., d)."""
        x[..., self.index if self.range is None else self.range] = values

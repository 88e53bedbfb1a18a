"""Torch's threads during the world's own small operations."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Runs torch operations on one thread.

    The world's arrays are small: handing them to other threads costs more than it saves, above all while the engine's
    threads want the same cores (measured on two cores, MT4, 1024 rows: see docs/results/speed.md).
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)

"""Torch's use of the machine: its threads, and memory that it has freed."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Run torch operations on one thread.

    The world's arrays are small: handing them to other threads costs more time than it saves, above all while the
    engine's threads use the same cores (measured on two cores, MT4, 1024 environments).
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def torch_settings_kept() -> Iterator[None]:
    """Restore the number of torch's threads and its choice of algorithms at the end of a block or decorated function.

    The caller's own work with torch would otherwise go on with the settings of a run.
    """
    threads = torch.get_num_threads()
    deterministic = torch.are_deterministic_algorithms_enabled()
    warns = torch.is_deterministic_algorithms_warn_only_enabled()
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        torch.use_deterministic_algorithms(deterministic, warn_only=warns)


def set_up_torch(threads: int, deterministic: bool = False) -> None:
    """Set the number of torch's threads, and the memory settings of the process for training.

    With ``deterministic`` torch only uses algorithms that repeat bit for bit on a GPU.
    """
    torch.set_num_threads(threads)
    torch.use_deterministic_algorithms(deterministic)  # also off: another run in this process may have set it
    if deterministic:
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # read when a GPU is first used
        # Filling new memory only serves to find bugs, and takes time.
        setattr(torch.utils.deterministic, "fill_uninitialized_memory", False)  # noqa: B010  # the stubs lack it
    keep_freed_memory()


def keep_freed_memory() -> None:
    """Let glibc keep up to 64 MB of freed memory for the next tensors; this has no effect without glibc.

    By default glibc returns free memory to the operating system beyond twice the size of the largest block that it has
    freed (blocks above 32 MB do not count). With small tensors every step then waits for new pages: an inner step of
    the meta-learners took up to twice as long, an MT-PPO update 3 % longer.
    """
    torch.empty(8_000_000)

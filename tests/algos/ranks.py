"""Runs a function in two processes that are joined as torchrun would join them."""

import multiprocessing
import os
import signal
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from bidex_meta.train import distributed

# A deadlock shall fail, not last; a busy machine shall do neither.
_DEADLOCK_SECONDS = 500


def in_two_processes(function: Callable[[int], Any], folder: Path) -> list[Any]:
    assert exit_codes(function, folder) == [0, 0]
    return [torch.load(folder / f"{rank}.pt", weights_only=False) for rank in range(2)]


def exit_codes(function: Callable[[int], Any], folder: Path) -> list[int | None]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    # Spawned, since a forked process would inherit torch's threads in an undefined state.
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=_one, args=(function, rank, port, folder)) for rank in range(2)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    return [process.exitcode for process in processes]


def _one(function: Callable[[int], Any], rank: int, port: int, folder: Path) -> None:
    torch.set_num_threads(1)
    signal.alarm(_DEADLOCK_SECONDS)
    places = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": 2, "LOCAL_WORLD_SIZE": 2, "MASTER_PORT": port}
    os.environ.update({name: str(value) for name, value in places.items()}, MASTER_ADDR="127.0.0.1")
    result = function(rank)
    distributed.shut_down()
    assert threading.enumerate() == [threading.main_thread()]
    torch.save(result, folder / f"{rank}.pt")


def same(a: Any, b: Any) -> bool:
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b

"""Runs in two processes that are joined as torchrun would join them, and learners that are saved and go on."""

import io
import multiprocessing
import os
import signal
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from bidex_meta.training import distributed

# A deadlock must fail and not last, but a busy machine must not fail.
_DEADLOCK_SECONDS = 500


def in_two_processes(function: Callable[[int], Any], folder: Path) -> list[Any]:
    assert exit_codes(function, folder) == [0, 0]
    return [torch.load(folder / f"{rank}.pt", weights_only=False) for rank in range(2)]


def exit_codes(function: Callable[[int], Any], folder: Path) -> list[int | None]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    # Processes are spawned, because a forked process would inherit torch's threads in an undefined state.
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


def resumed(make: Callable[[int], Any], iterations: int = 3) -> tuple[Any, Any]:
    """Two learners after twice as many iterations: one without a break, one saved and loaded half-way.

    ``make``: A learner of a seed, with its world as ``learner.world``; ``iterations``: before the break, and after it.
    Raises AssertionError: their metrics differ after the break, or their states at the end.
    """
    unbroken = make(0)
    for _ in range(iterations):
        unbroken.iterate()
    file = io.BytesIO()
    torch.save({"learner": unbroken.state_dict(), "env": unbroken.world.state_dict()}, file)
    file.seek(0)
    state = torch.load(file, weights_only=True)
    again = make(77)
    again.world.load_state_dict(state["env"])
    again.load_state_dict(state["learner"])
    for _ in range(iterations):
        a, b = ({k: v for k, v in each.iterate().items() if "Perf" not in k} for each in (unbroken, again))
        assert a == b
    ends = [each.state_dict() for each in (unbroken, again)]
    for end in ends:
        end["policy"].pop("seed", None)  # the learner sets it, and the test lets it differ
    assert same(*ends)
    return unbroken, again

"""The way this process was started: as the only one, or by torchrun as one of several that share a run."""

import logging
import os
import signal
from dataclasses import dataclass
from pathlib import Path

_LOG = logging.getLogger("bidex_meta")


def say(text: str) -> None:
    """Log a line at level INFO; with several processes, only process 0 logs it."""
    if launch().rank == 0:
        _LOG.info(text)


@dataclass(frozen=True)
class Launch:
    """Rank of this process and number of processes of the run, from torchrun's environment variables."""

    rank: int = 0  # only process 0 writes and prints
    count: int = 1  # number of processes on all machines
    local_rank: int = 0  # rank among the processes of the same machine
    local_count: int = 1  # number of processes on the same machine

    def own_device(self, device: str) -> str:
        """Return the device of this process.

        With several processes per machine, each takes the GPU of its local rank.
        """
        if self.count > 1 and device == "cuda":
            return f"cuda:{self.local_rank}"
        return device


def launch() -> Launch:
    """Return this process's rank and the number of processes, read from the environment variables on every call."""
    # A batch system may set WORLD_SIZE for other reasons. torchrun also sets the address at which processes meet.
    if "MASTER_ADDR" not in os.environ:
        return Launch()
    defaults = {"RANK": 0, "WORLD_SIZE": 1, "LOCAL_RANK": 0, "LOCAL_WORLD_SIZE": 1}
    return Launch(*(int(os.environ.get(name, default)) for name, default in defaults.items()))


BATCH_SIGNALS = tuple(signal.Signals[name] for name in ("SIGUSR1", "SIGUSR2") if hasattr(signal, name))
"""Signals that batch systems send before the time of a job is up; Windows has neither."""


def notices() -> tuple[signal.Signals, ...]:
    """Return the signals other than SIGINT and SIGTERM that ask a process to end; ignored signals are left out.

    SIGHUP comes when the terminal closes (``nohup`` ignores it). The others are ``BATCH_SIGNALS``. Each signal may come
    several times: from the terminal and its shell, or from the batch system and the job that it runs.
    """
    if os.name == "posix":
        numbers = (signal.SIGHUP, *BATCH_SIGNALS)
    else:
        numbers = ()
    return tuple(number for number in numbers if signal.getsignal(number) != signal.SIG_IGN)


def resume_command(path: Path, processes: int) -> str:
    """Return the command that continues the run in folder ``path`` with this number of processes."""
    if processes == 1:
        return f"bidex-meta run --resume {path}"
    here = launch()
    if here.count == processes:
        nodes = processes // here.local_count
    else:
        nodes = 1
    machines = f"--nnodes {nodes} " if nodes > 1 else ""
    return f"torchrun {machines}--nproc-per-node {processes // nodes} -m bidex_meta.cli run --resume {path}"

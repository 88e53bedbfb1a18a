"""Memory of a world, a replay or a network, checked before it is allocated: running out ends others' work."""

import os
import sys
from pathlib import Path

import psutil

from bidex_meta.errors import BidexError

ROW_BYTES = 500_000
"""Of an environment on the CPU: measured 0.39 MB on MT4 and 0.48 on MT20, with 1000 each."""
POINT_BYTES = 100
"""Of a point of an environment's cloud: calculated, in the observation, its copies in a step's info and sources."""


def usable_cores() -> int:
    """Cores that this process may use, not those of the machine: containers and batch systems give a share."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def available() -> int:
    """Free bytes, by the system (with what can be swapped) and by the container's limit."""
    of_system = psutil.virtual_memory().available + psutil.swap_memory().free
    of_container = _of_container()
    return of_system if of_container is None else min(of_system, of_container)


def check_memory(needed: float, what: str, mend: str) -> None:
    """Raises BidexError where fewer than ``needed`` bytes are free.

    ``what`` takes them (``"1,000 rows"``); ``mend`` is the advice after the error's sentence.
    """
    there = available()
    if needed > there:
        raise BidexError(f"{what} would take about {needed / 1e9:,.1f} GB, and {there / 1e9:,.1f} are free. {mend}")


def _of_container() -> int | None:
    """What a control group still gives (version 2)."""
    group = Path("/sys/fs/cgroup")
    try:
        limit, used = (int((group / f"memory.{name}").read_text()) for name in ("max", "current"))
        stat = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        return limit - used + int(stat.get("inactive_file", 0))  # pages of files are given back
    except (OSError, ValueError):
        return None

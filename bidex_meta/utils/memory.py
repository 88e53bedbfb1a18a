"""Memory and cores that this process may use.

The memory of a world, a replay or a network is checked before it is allocated, because running out of memory may end
other processes.
"""

import math
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil

from bidex_meta.errors import BidexError

ROW_BYTES = 500_000
"""Memory of one environment on the CPU, bytes. We measured 0.39 MB on MT4 and 0.48 MB on MT20 with 1000
environments."""
POINT_BYTES = 100
"""Memory of one point of an environment's cloud, bytes; calculated from the observation, from its copies in the
``info`` of a step and from the data that clouds are made of."""
_ROOT = Path("/")  # holds proc and sys; tests give another folder


def usable_cores() -> int:
    """Count the cores that this process may use, by its affinity and by the CPU quota of its control groups.

    A quota of one and a half cores counts as two cores; one of two threads then waits part of the time.
    """
    if sys.platform == "linux":
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    return max(1, min([cores, *map(math.ceil, _cpu_quotas())]))


def available() -> int:
    """Count the free bytes of the system (including swap), or of a control group if that has fewer."""
    of_system = psutil.virtual_memory().available + psutil.swap_memory().free
    return max(0, min([of_system, *_free_of_groups()]))


def check_memory(needed: float, what: str, mend: str) -> None:
    """Raise BidexError if fewer than ``needed`` bytes are free.

    ``what`` names the object that takes the memory (``"1,000 rows"``); ``mend`` is the advice at the end of the
    message.
    """
    there = available()
    if needed > there:
        raise BidexError(
            f"{what} would take about {needed / 1e9:,.1f} GB, but only {there / 1e9:,.1f} are free. {mend}"
        )


def _free_of_groups() -> Iterator[int]:
    """Yield, for each memory limit of this process's control groups, the number of bytes that are still free.

    Inactive pages of files count as free, because the kernel gives them back before it kills a process.
    """
    names = (
        ("memory.max", "memory.current", "inactive_file"),  # version 2 of control groups
        ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),  # version 1
    )
    for group in _groups("memory"):
        for limit, used, inactive in names:
            values = _numbers(group / limit) + _numbers(group / used)
            if len(values) == 2:
                yield values[0] - values[1] + _entries(group / "memory.stat").get(inactive, 0)


def _cpu_quotas() -> Iterator[float]:
    """Yield, for each CPU quota of this process's control groups, the number of cores whose time it allows."""
    for group in _groups("cpu"):
        version_1 = _numbers(group / "cpu.cfs_quota_us") + _numbers(group / "cpu.cfs_period_us")
        for quota in (_numbers(group / "cpu.max"), version_1):
            if len(quota) == 2 and min(quota) > 0:  # version 1 writes -1 for no quota
                yield quota[0] / quota[1]


def _groups(controller: str) -> Iterator[Path]:
    """Yield the cgroup folders that may limit this process: those of its control groups and of their parent groups.

    ``controller`` is the resource, such as ``"cpu"``. Inside a container, the path of a group may be its path on the
    host. Then only one of the yielded folders exists: the root folder, which stands for the last group of the path.
    """
    root = _ROOT / "sys" / "fs" / "cgroup"
    for line in _text(_ROOT / "proc" / "self" / "cgroup").splitlines():
        _, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if controllers and controller not in controllers.split(","):
            continue
        place = Path(path.lstrip("/"))
        # Version 2 has one tree. If the machine also has version 1, the tree is in a folder "unified".
        trees = (controller, controllers) if controllers else (".", "unified")
        for tree in trees:
            yield from (root / tree / group for group in (place, *place.parents))


def _numbers(path: Path) -> list[int]:
    """Read the numbers of a file; none if the file is missing or says ``max``."""
    words = _text(path).split()
    if all(word.lstrip("-").isdigit() for word in words):
        return [int(word) for word in words]
    return []


def _entries(path: Path) -> dict[str, int]:
    """Read a file whose lines each have a name and a number; return the numbers by name."""
    pairs = [line.split() for line in _text(path).splitlines()]
    return {pair[0]: int(pair[1]) for pair in pairs if len(pair) == 2 and pair[1].isdigit()}


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except (OSError, ValueError):
        return ""

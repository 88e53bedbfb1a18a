"""Limits of control groups, of both versions, as files in a folder that stands for the machine's root."""

from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from bidex_meta.errors import BidexError
from bidex_meta.utils import memory

GB = 10**9


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A machine of 64 cores and 100 free GB; writes files of /proc and /sys by their paths."""
    monkeypatch.setattr(memory, "_ROOT", tmp_path)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=100 * GB))
    monkeypatch.setattr(psutil, "swap_memory", lambda: SimpleNamespace(free=0))
    monkeypatch.setattr(memory, "sys", SimpleNamespace(platform="elsewhere"))
    monkeypatch.setattr(memory.os, "cpu_count", lambda: 64)

    def write(files: dict[str, object]) -> None:
        for name, content in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{content}\n")

    return write


def of_version_1(folder: str, limit: int, used: int, cached: int) -> dict[str, object]:
    return {
        f"sys/fs/cgroup/memory{folder}/memory.limit_in_bytes": limit,
        f"sys/fs/cgroup/memory{folder}/memory.usage_in_bytes": used,
        f"sys/fs/cgroup/memory{folder}/memory.stat": f"inactive_file 1\ntotal_inactive_file {cached}",
    }


def of_version_2(folder: str, limit: object, used: int, cached: int) -> dict[str, object]:
    return {
        f"sys/fs/cgroup{folder}/memory.max": limit,
        f"sys/fs/cgroup{folder}/memory.current": used,
        f"sys/fs/cgroup{folder}/memory.stat": f"anon 5\ninactive_file {cached}",
    }


UNLIMITED = 2**63 - 4096  # what version 1 says of no limit
V1 = "9:name=systemd:/\n4:memory:/job/step\n2:cpu,cpuacct:/job/step\n0::/job"


@pytest.mark.parametrize(
    ("groups", "files", "free"),
    [
        (V1, of_version_1("/job/step", 8 * GB, 5 * GB, GB), 4 * GB),
        (V1, of_version_1("/job/step", UNLIMITED, 5 * GB, 0) | of_version_1("/job", 9 * GB, 7 * GB, 0), 2 * GB),
        ("4:memory:/docker/0123", of_version_1("", 8 * GB, 5 * GB, 0), 3 * GB),
        ("0::/job/step", of_version_2("/job/step", "max", 5 * GB, 0), 100 * GB),
        ("0::/job/step", of_version_2("/job/step", 8 * GB, 5 * GB, GB), 4 * GB),
        ("0::/job/step", of_version_2("/job", 6 * GB, 5 * GB, 0) | of_version_2("/job/step", "max", GB, 0), GB),
        ("0::/", of_version_2("", 8 * GB, 9 * GB, 0), 0),
        ("4:memory:/\n0::/", of_version_2("/unified", 8 * GB, 5 * GB, 0), 3 * GB),
        ("", {}, 100 * GB),
    ],
    ids=["v1", "v1 nested", "v1 container", "v2 none", "v2", "v2 nested", "v2 full", "hybrid", "no groups"],
)
def test_the_least_memory_of_the_system_and_its_groups(machine, groups: str, files: dict, free: int) -> None:
    machine({"proc/self/cgroup": groups, **files})
    assert memory.available() == free
    with pytest.raises(BidexError, match=f"{free / GB:,.1f} are free. Ask for less."):
        memory.check_memory(free + GB, "1,000 rows", "Ask for less.")


@pytest.mark.parametrize(
    ("groups", "files", "cores"),
    [
        (V1, {"cpu,cpuacct/job/step/cpu.cfs_quota_us": 250_000, "cpu,cpuacct/job/step/cpu.cfs_period_us": 100_000}, 3),
        (V1, {"cpu/job/cpu.cfs_quota_us": 200_000, "cpu/job/cpu.cfs_period_us": 100_000}, 2),
        (V1, {"cpu/cpu.cfs_quota_us": -1, "cpu/cpu.cfs_period_us": 100_000}, 64),
        ("0::/job/step", {"job/step/cpu.max": "max 100000", "job/cpu.max": "150000 100000"}, 2),
        ("0::/job/step", {"job/step/cpu.max": "1000 100000"}, 1),
        ("0::/", {"cpu.max": "9900000 100000"}, 64),
        ("0::/", {"cpu.max": "nonsense"}, 64),
    ],
    ids=["v1", "v1 outer", "v1 none", "v2 outer", "v2 a hundredth", "v2 more than there are", "v2 damaged"],
)
def test_cores_are_no_more_than_the_quota_pays_for(machine, groups: str, files: dict, cores: int) -> None:
    machine({"proc/self/cgroup": groups, **{f"sys/fs/cgroup/{name}": content for name, content in files.items()}})
    assert memory.usable_cores() == cores

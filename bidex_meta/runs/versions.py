"""``versions.json``: packages, machine and commit, on which a result depends in addition to the run's config."""

import contextlib
import os
import platform
import subprocess
import sys
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path

from bidex_meta.runs.atomic import Json
from bidex_meta.utils.files import exists, read_json
from bidex_meta.utils.validation import Text, Whole, parse

_PACKAGES = ("bidex-meta", "mujoco", "mujoco-warp", "warp-lang", "torch", "gymnasium", "metaworld", "numpy", "scipy")


@dataclass(frozen=True)
class GitState:
    """The commit of the source; ``dirty`` is True if files differed from it."""

    commit: Text | None = None
    dirty: bool = False


@dataclass(frozen=True)
class Versions:
    """The entries of ``versions.json`` that are read; other entries are allowed, and any entry may be missing."""

    packages: dict[str, Text | None] = field(default_factory=dict)
    physics: Text | None = None
    suite_version: Whole | None = None
    suite_digest: Text | None = None
    cpus: Whole | None = None
    gpus: list[Text] | None = None
    git: GitState | None = None
    teacher_steps: list[Whole] | None = None  # environment steps of the runs that teach


def parse_versions(content: Json, where: str) -> Versions:
    """Return the content of a ``versions.json``; raises BidexError, which begins with ``where``, for a wrong entry."""
    return parse(content, Versions, where)


def read_versions(folder: Path) -> Json:
    """Return a run's ``versions.json``, checked; empty if the file is missing."""
    path = folder / "versions.json"
    if not exists(path):
        return {}
    content = read_json(path, "a run's versions")
    parse_versions(content, str(path))
    return content


def collect_versions() -> Json:
    """Return Python, packages (None if not installed), machine, GPUs and git state, ready for JSON."""
    import torch

    return {
        "python": sys.version.split()[0], "packages": package_versions(), "platform": platform.platform(),
        "cpus": os.cpu_count(),
        "gpus": [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())],
        "git": git_state(Path(__file__).parent),
    }  # fmt: skip


def package_versions() -> dict[str, str | None]:
    """Return the versions of all packages that results depend on; None for a package that is not installed."""
    versions: dict[str, str | None] = dict.fromkeys(_PACKAGES)
    for name in _PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions


def git_state(folder: Path) -> Json | None:
    """Return the commit and whether files changed since; None if ``folder`` is not tracked by git.

    If this package is installed inside a user's project, it lies in the project's repository without being tracked. The
    project's commit would not describe this package, so the function checks that the folder's files are tracked.
    """
    if not _git(folder, "ls-files", "."):
        return None
    commit = _git(folder, "rev-parse", "HEAD")
    if commit:
        return {"commit": commit, "dirty": bool(_git(folder, "status", "--porcelain"))}
    return None


def _git(folder: Path, *arguments: str) -> str:
    try:
        done = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    if done.returncode == 0:
        return done.stdout.strip()
    return ""

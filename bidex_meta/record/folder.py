"""The run folder: what was run, with what, and what came out.

::

    runs/<suite>/<algo>/<UTC date-time>_seed<seed>/
        config.json     the resolved config: every value, also the defaults
        versions.json   Python, packages, machine, git commit
        metrics.jsonl   one line a log call: {"step": ..., "time": ..., "Train/mean_return": ...}
        events.out...   the same for TensorBoard
        checkpoints/    step_<N>.pt (the last few), last.pt, best.pt
        videos/         <name>_<N>.mp4
"""

import json
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bidex_meta.errors import BidexError
from bidex_meta.record.atomic import remove_leftovers, write_json
from bidex_meta.record.checkpoints import Checkpoints
from bidex_meta.record.versions import collect_versions

_KEYS = ("suite", "task", "algo", "seed")
"""What every run's config holds."""


@dataclass(frozen=True)
class RunFolder:
    """One run on disk. Made by ``create`` or ``open``."""

    path: Path

    @classmethod
    def create(cls, config: dict[str, Any], path: Path | None = None, root: Path = Path("runs")) -> "RunFolder":
        """Make a new, complete run folder: after this call only metrics, checkpoints and videos are added.

        Args:
            config: The resolved config, ready for JSON; its ``suite`` (or ``task``), ``algo`` and
                ``seed`` name the folder.
            path: The folder itself, instead of one under ``root`` named after the config.
            root: Where runs are collected.

        Raises:
            BidexError: ``path`` exists and is not empty.
        """
        folder = cls(_new_folder(config, root) if path is None else _given_folder(path))
        folder.checkpoints_path.mkdir()
        folder.videos_path.mkdir()
        folder.metrics_path.touch()
        write_json(folder.path / "versions.json", collect_versions())
        write_json(folder.config_path, config)  # last: a folder with a config.json is a complete one
        return folder

    @classmethod
    def open(cls, path: Path) -> "RunFolder":
        """An existing run.

        Raises:
            BidexError: There is no readable ``config.json``.
        """
        folder = cls(Path(path))
        if not folder.config_path.is_file():
            near = sorted(str(found.parent) for found in folder.path.glob("**/config.json"))[:3]
            hint = f" There are runs below it: {', '.join(near)}." if near else ""
            raise BidexError(f"{path} is not a run folder: it has no config.json.{hint}")
        return folder

    @property
    def config_path(self) -> Path:
        """``config.json``."""
        return self.path / "config.json"

    @property
    def metrics_path(self) -> Path:
        """``metrics.jsonl``."""
        return self.path / "metrics.jsonl"

    @property
    def checkpoints_path(self) -> Path:
        """``checkpoints/``."""
        return self.path / "checkpoints"

    @property
    def videos_path(self) -> Path:
        """``videos/``."""
        return self.path / "videos"

    @property
    def checkpoints(self) -> Checkpoints:
        """The run's checkpoints."""
        self.checkpoints_path.mkdir(exist_ok=True)
        return Checkpoints(self.checkpoints_path)

    def config(self) -> dict[str, Any]:
        """The resolved config.

        Raises:
            BidexError: ``config.json`` is not valid JSON, or not a run's.
        """
        try:
            config = json.loads(self.config_path.read_text())
        except json.JSONDecodeError as error:
            raise BidexError(f"{self.config_path} is not valid JSON: {error}.") from None
        missing = [name for name in _KEYS if not isinstance(config, dict) or name not in config]
        if missing:
            raise BidexError(f"{self.config_path} is not a run's config: it lacks {', '.join(missing)}. Name a run.")
        return config

    def change_config(self, config: dict[str, Any]) -> None:
        """Replace ``config.json``, atomically."""
        remove_leftovers(self.path)
        write_json(self.config_path, config)


def flat(config: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """A config without nesting: ``{"learner": {"gamma": 0.9}}`` becomes ``{"learner.gamma": 0.9}``."""
    found: dict[str, Any] = {}
    for name, value in config.items():
        found.update(flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value})
    return found


def _new_folder(config: dict[str, Any], root: Path) -> Path:
    subject = Path(str(config.get("suite") or config.get("task"))).stem  # a suite may be a path to a TOML file
    now = datetime.now(UTC).strftime("%Y-%m-%d_%H-%M-%S")
    algo = str(config["algo"]).rpartition(":")[2]  # of package.module:Class the class
    base = root / subject / algo / f"{now}_seed{config['seed']}"
    base.parent.mkdir(parents=True, exist_ok=True)
    path, count = base, 1
    while True:
        try:
            path.mkdir()  # fails where it exists, so two runs started in one second never share a folder
            return path
        except FileExistsError:
            count += 1
            path = base.with_name(f"{base.name}_{count}")


def _given_folder(path: Path) -> Path:
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise BidexError(
            f"--run-dir {path} exists and is not empty. Name a new folder, or continue it by --resume {path}."
        )
    path.mkdir(parents=True, exist_ok=True)
    return path

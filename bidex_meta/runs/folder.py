"""The run folder: config, versions, metrics, checkpoints, videos and evaluation of a run.

::

    runs/<suite>/<algo>/<UTC date-time>_seed<seed>/
        config.json     the resolved config: every value, also the defaults
        versions.json   Python, packages, machine, git commit; physics profile and version of the suite
        metrics.jsonl   one line per log call: {"step": ..., "time": ..., "Train/mean_return": ...}
        events.out...   the same for TensorBoard
        checkpoints/    step_<N>.pt (the last few), last.pt, best.pt
        videos/         <name>_<N>.mp4
        evaluation.json the final evaluation of the trained policy
"""

import contextlib
import os
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bidex_meta.config import RunConfig, read_config
from bidex_meta.errors import BidexError
from bidex_meta.runs.atomic import TEMPORARY_SUFFIX, Json, check_writable, refuse_links, remove_leftovers, write_json
from bidex_meta.runs.checkpoints import Checkpoints
from bidex_meta.runs.evaluations import Evaluated, read_evaluation
from bidex_meta.runs.metrics import last_rows, read_metrics
from bidex_meta.runs.versions import collect_versions, read_versions
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.files import exists, is_file, read_json
from bidex_meta.utils.plugins import name_with_object, short_name
from bidex_meta.utils.validation import Whole

try:
    import fcntl
except ImportError:  # Windows has no such locks
    fcntl = None

AnyConfig = RunConfig[Any]  # A run's config, with its learner's settings in any form
_ENTRIES = ("checkpoints", "videos", "metrics.jsonl", "versions.json", "config.json", "replay", "wandb", "wandb-id")
"""Entries of a run folder before the end of its first iteration, apart from TensorBoard's file."""
_EVENTS = "events.out.tfevents."
_MOST_LOOKED_AT = 2000  # maximum number of entries that are searched for runs below a folder that is not a run


class _Part:
    """Attribute of :class:`RunFolder` that returns the path of a file or subfolder in the run's folder."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, folder: "RunFolder", kind: type["RunFolder"]) -> Path:
        return folder.path / self._name


@checked_arguments
@dataclass(frozen=True)
class RunFolder:
    """One run on disk, from ``create`` or ``open``."""

    path: Path

    @classmethod
    @checked_arguments
    def create(
        cls, config: AnyConfig, path: Path | None = None, root: Path = Path("runs"), identity: Json | None = None
    ) -> "RunFolder":
        """Make a new, complete run folder: after this call only metrics, checkpoints and videos are added.

        The folder is ``path``, or a new folder under ``root`` that is named after the resolved config. ``identity``
        distinguishes the run's worlds from other worlds of the same name; it goes into ``versions.json``. Raises
        BidexError if ``path`` is not empty.
        """
        if path is None:
            path = _new_folder(config, root)
        else:
            check_new(path)
            path.mkdir(parents=True, exist_ok=True)
        folder = cls(path)
        for part in (folder.checkpoints_path, folder.videos_path):
            part.mkdir(exist_ok=True)  # the folder exists if an earlier start was killed before its config was written
        folder.metrics_path.touch()
        write_json(folder.path / "versions.json", collect_versions() | (identity or {}))
        write_json(folder.config_path, config.to_json())  # last, because a folder with a config.json counts as complete
        return folder

    @classmethod
    @checked_arguments
    def open(cls, path: str | Path) -> "RunFolder":
        """Open an existing run; raises BidexError if there is no ``config.json``."""
        folder = cls(Path(path))
        if not is_file(folder.config_path):
            near = sorted(map(str, _runs_below(folder.path)))[:3]
            if near:
                hint = f" There are runs below it: {', '.join(near)}."
            else:
                hint = ""
            if not near and _torn_start(folder.path):
                hint = f" Its run was killed as it began. Begin again: --run-dir {path}"
            raise BidexError(f"{path} is not a run folder: it has no config.json.{hint}")
        return folder

    config_path = _Part("config.json")
    metrics_path = _Part("metrics.jsonl")
    checkpoints_path = _Part("checkpoints")
    videos_path = _Part("videos")
    evaluation_path = _Part("evaluation.json")  # the file exists once the run has ended and was evaluated

    @property
    def checkpoints(self) -> Checkpoints:
        """Return the run's checkpoints."""
        return Checkpoints(self.checkpoints_path)

    def config(self) -> RunConfig[Json]:
        """Return the resolved config; raises BidexError if ``config.json`` cannot be read or is not a run's config."""
        return read_config(self.config_path)

    @property
    def again(self) -> str:
        """Return the command that repeats the run's evaluation, for messages."""
        return f"bidex-meta evaluate {self.path} --json > {self.evaluation_path}"

    @property
    def evaluated(self) -> bool:
        """Return whether there is an ``evaluation.json``."""
        return is_file(self.evaluation_path)

    def metrics(self) -> list[Json]:
        """Return the rows of ``metrics.jsonl`` that can be read."""
        return read_metrics(self.metrics_path)

    @property
    def goal(self) -> int:
        """Return the environment steps for which the run trains.

        If the run ended early because of a time limit, a return or a score, these are the steps that were done.
        """
        rows = last_rows(self.metrics_path)
        return self.config().goal(rows[-1] if rows else {"step": 0})

    def versions(self) -> Json:
        """Return the content of ``versions.json``; empty if there is none."""
        return read_versions(self.path)

    def evaluation(self) -> Evaluated:
        """Return the final evaluation, or the meta-test of learners that adapt; raises BidexError if there is none."""
        if not exists(self.evaluation_path):
            raise BidexError(f"{self.path} has no evaluation.json. Let the run end, or write one: {self.again}")
        return read_evaluation(self.evaluation_path, self.again)

    @checked_arguments
    def change_config(self, config: AnyConfig) -> None:
        """Replace ``config.json``, atomically, if its content differs."""
        if read_json(self.config_path, "a run's config") != config.to_json():
            write_json(self.config_path, config.to_json())

    @checked_arguments
    def finish(self, step: Whole | None) -> None:
        """Remove incomplete files that an earlier process left when it was killed; the folder must be locked.

        ``step`` is the step of the loaded checkpoint; None if there is none. An incomplete save of this checkpoint is
        completed.
        """
        remove_leftovers(self.path)
        if step is not None:
            self.checkpoints.finish(step)

    def check_own(self) -> None:
        """Raise BidexError if the run cannot write into its folder, or if a file or subfolder in it is a link.

        Writing through a link would change files outside the folder. The check is made before any world or learner is
        built.
        """
        refuse_links(self.checkpoints_path, self.videos_path, self.metrics_path, self.path / "wandb-id")
        for folder in (self.path, self.checkpoints_path):
            if folder == self.path or folder.exists():
                check_writable(folder / "last.pt")

    @contextlib.contextmanager
    def locked(self, message: str | None = None) -> Iterator[None]:
        """Keep other processes from training in this folder while the block runs.

        The lock also ends if this process is killed, and leaves no file. Raises BidexError, with ``message``, if
        another process holds the lock.
        """
        if fcntl is None:  # such a system cannot open folders either
            yield
            return
        handle = os.open(self.path, os.O_RDONLY)
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                message = message or f"Another process trains in {self.path}. Wait for its end, or stop it."
                raise BidexError(message) from None
            except OSError:
                pass  # a network file system may not lock folders
            yield
        finally:
            os.close(handle)


def _runs_below(path: Path) -> Iterator[Path]:
    """Return run folders up to three levels below, as in runs/SUITE/ALGO/RUN, without walking a whole disk."""
    waiting = deque([(path, 0)])
    looked_at = 0
    while waiting:
        folder, depth = waiting.popleft()
        with contextlib.suppress(OSError, ValueError), os.scandir(folder) as entries:
            for entry in entries:
                looked_at += 1
                if looked_at > _MOST_LOOKED_AT:
                    return
                if entry.name == "config.json" and entry.is_file():
                    yield folder
                elif depth < 3 and entry.is_dir(follow_symlinks=False):
                    waiting.append((Path(entry.path), depth + 1))


def _torn_start(path: Path) -> bool:
    """Return whether a folder only holds files that a run makes before the end of its first iteration."""
    try:
        entries = list(path.iterdir())
        whole = [entry for entry in entries if not entry.name.endswith(TEMPORARY_SUFFIX)]
        if not whole:
            # A single temporary file belongs to the config: the check whether the config can be written was killed.
            checked = [entry for entry in entries if entry.name.startswith(".config.json.")]
            return bool(entries) and checked == entries and not any(entry.is_symlink() for entry in entries)
        return all(_is_of_a_start(entry) for entry in whole)
    except OSError:
        return False


def _is_of_a_start(entry: Path) -> bool:
    """Return whether an entry of a run folder can exist before the end of the first iteration."""
    if entry.is_symlink():
        return False
    if entry.name in ("checkpoints", "videos"):  # temporary files reserve space for a checkpoint
        return all(inner.name.endswith(TEMPORARY_SUFFIX) for inner in entry.iterdir())
    if entry.name == "metrics.jsonl":
        return entry.stat().st_size == 0
    return entry.name in _ENTRIES or entry.name.startswith(_EVENTS)


def new_folder_name(config: AnyConfig, root: Path = Path("runs")) -> Path:
    """Return the default folder of a run, from its config and the present time."""
    # A suite may be a path to a TOML file, task and algo package.module:Class.
    subject = name_with_object(short_name(Path(config.suite or str(config.task)).stem), config.object)
    now = datetime.now(UTC).strftime("%Y-%m-%d_%H-%M-%S")
    return root / subject / short_name(config.algo) / f"{now}_seed{config.seed}"


def _new_folder(config: AnyConfig, root: Path) -> Path:
    base = new_folder_name(config, root)
    base.parent.mkdir(parents=True, exist_ok=True)
    path = base
    count = 1
    while True:
        try:
            path.mkdir()  # fails if it exists, so two runs started in one second never share a folder
            return path
        except FileExistsError:
            count += 1
            path = base.with_name(f"{base.name}_{count}")


def check_new(path: Path) -> None:
    """Raise BidexError if a run cannot begin in a folder.

    A run cannot begin if the folder cannot be written, if another process trains there, or if it holds anything other
    than a run that ended before its first iteration.
    """
    if exists(path) and not (path.is_dir() and (_torn_start(path) or not any(path.iterdir()))):
        raise BidexError(
            f"--run-dir {path} exists and is not empty. Name a new folder, or continue it by --resume {path}."
        )
    if is_file(path / "config.json"):
        with RunFolder(path).locked():
            pass
    check_writable(path / "config.json")

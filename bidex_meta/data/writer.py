"""Write a data set: choose its path and name, write its parts (each is complete or absent), and its index last."""

import contextlib
import json
import math
import os
import re
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from bidex_meta.data import part_files, seals
from bidex_meta.data.dataset import data_folder
from bidex_meta.data.part_files import Episode, Json
from bidex_meta.errors import BidexError, shortened
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import check_writable, remove_leftovers, write_atomic, write_json
from bidex_meta.utils.files import absolute, exists, expanded, is_file, read_json
from bidex_meta.utils.plugins import short_name
from bidex_meta.utils.validation import Threads, parse

_MARGIN = 1.05  # file systems need about 5 % more space than the files
_MINARI = "0.5.0"  # version of Minari whose layout is written
_NAME = re.compile(r"(?:[-\w]+/)*[-\w]+-v\d{1,4}", re.ASCII)
"""Names that Minari accepts: words of letters, digits, - and _, separated by /, and a version such as -v0."""


@dataclass(frozen=True)
class _Plan:
    """The entries that a resumed recording reads from its stored plan."""

    threads: Threads | None = None


def default_name(subject: str, kind: str) -> str:
    """Return the name, such as ``CatchUnderarm/random-v0``, of a new data set of a suite, a suite file or a class."""
    if ":" in subject:
        return f"{short_name(subject)}/{kind}-v0"
    if subject.endswith(".toml"):
        parts = [Path(subject).stem]
    else:
        parts = subject.split("/")
    words = [re.sub(r"[^\w-]+", "-", word) for word in parts]
    return f"{'/'.join(words)}/{kind}-v0"


def dataset_path(out: Path | None, subject: str, kind: str) -> tuple[Path, str]:
    """Return the folder and the name of a new data set of a suite or class.

    ``out`` is the folder, and the name follows from its path. If ``out`` is None, the name is ``default_name``, and the
    folder is the one of this name in the data folder.
    """
    root = data_folder()
    usual = default_name(subject, kind)
    if out is None:
        return root / usual, usual
    folder = expanded(out)
    try:
        name = absolute(folder).relative_to(absolute(root)).as_posix()
    except ValueError:
        name = "/".join(folder.parts[-2:])
    return folder, next((n for n in (name, folder.name, usual) if _NAME.fullmatch(n)), usual)


def check_name(name: str) -> None:
    """Raise BidexError for a name that Minari does not accept."""
    if not _NAME.fullmatch(name):
        raise BidexError(f"Expected a name such as CatchUnderarm/random-v0, got {name!r}. Name another path by --out.")


def check_room(folder: Path, needed: int, subject: str) -> None:
    """Raise BidexError if the disk of a folder has too few bytes free; the folder need not exist.

    ``needed`` is the number of bytes that will be written. ``subject`` says in the message what needs them.
    """
    there = next(above for above in (folder.absolute(), *folder.absolute().parents) if exists(above))
    free = shutil.disk_usage(there).free
    if needed * _MARGIN > free:
        needs = f"{subject} would take about {needed / 1e9:,.1f} GB, and {free / 1e9:,.1f} are free at {there}"
        raise BidexError(f"{needs}. Lower --size, or name another path by --out.")


class DatasetWriter:
    """Writes the episodes of one process into parts of a data set.

    The argument ``folder`` is the data set's folder, and the attribute ``folder`` is its subfolder ``data``. Each
    ``process`` has its own parts. A new writer keeps the first ``keep`` parts of its process and deletes later ones.
    ``parts`` is the number of committed parts. ``left_out`` counts, by reason, the transitions and episodes that were
    not stored since the last commit; the collector adds to these counts.
    """

    def __init__(self, folder: Path, process: int = 0, keep: int = 0) -> None:
        self.folder = folder / "data"
        self.process = process
        self.parts = keep
        self.left_out: Counter[str] = Counter()
        part_files.hdf5()
        self.folder.mkdir(parents=True, exist_ok=True)
        part_files.remove_parts(self.folder, process, keep)
        self._part: part_files.PartWriter | None = None

    @property
    def open_steps(self) -> int:
        """Return the number of transitions that are not committed yet."""
        return 0 if self._part is None else self._part.steps

    def add(self, episode: Episode) -> None:
        """Write an episode, which is lost unless ``commit`` follows."""
        self._open().add(episode)

    def commit(self) -> None:
        """Complete a part from the episodes and counts added since the last part, if there are any."""
        if self._part is None and not self.left_out.total():
            return
        self._open().commit(dict(self.left_out))
        self._part = None
        self.parts = self.parts + 1
        self.left_out = Counter()

    def _open(self) -> part_files.PartWriter:
        if self._part is None:
            self._part = part_files.PartWriter(part_files.part_path(self.folder, self.process, self.parts))
        return self._part

    def close(self) -> None:
        """Drop the episodes that were not committed."""
        if self._part is not None:
            self._part.abandon()
            self._part = None


@contextlib.contextmanager
def claimed(folder: Path, plan: Json) -> Iterator[None]:
    """Lock a folder against other processes while the ``with`` block records into it.

    The folder is created first. If it is empty after the block, it is removed again. Arguments and errors are those of
    ``has_begun``; BidexError is also raised if another process records there.
    """
    message = f"Another process records into {folder}. Wait for its end, or name another path by --out."
    missing = [above for above in (folder, *folder.parents) if not exists(above)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = contextlib.ExitStack()
        lock.enter_context(RunFolder(folder).locked(message))
    except OSError as error:
        raise BidexError(f"{folder} cannot be written: {error.strerror}. Name another path by --out.") from None
    with lock:
        if not folder.is_dir():
            raise BidexError(message)  # another process, which was refused, has removed the folder
        try:
            has_begun(folder, plan)
            yield
        finally:
            with contextlib.suppress(OSError):  # the folder is not empty
                for above in missing:
                    above.rmdir()


def begin(folder: Path, plan: Json) -> None:
    """Write the plan of a collection; arguments and errors are those of ``has_begun``."""
    if not has_begun(folder, plan):
        (folder / "data").mkdir(parents=True, exist_ok=True)
        write_json(folder / "data" / part_files.RECORDING, plan)


def stored_plan(folder: Path) -> Json:
    """Read the plan of a collection that has begun in a folder; return an empty dict if there is no plan.

    Raises BidexError if the file is not a plan.
    """
    path = folder / "data" / part_files.RECORDING
    if not is_file(path):
        return {}
    plan = read_json(path, "a recording's plan")
    parse(plan, _Plan, str(path))
    return plan


def has_begun(folder: Path, plan: Json) -> bool:
    """Return whether the same collection has begun in a folder, so that the same command resumes it.

    ``plan`` holds everything that decides what is collected, ready for JSON. BidexError is raised if the data set's
    folder holds a complete data set, another recording, or other files.
    """
    inner = folder / "data"
    path = inner / part_files.RECORDING
    # If metadata and plan both exist, the process was killed between its last two steps, so the index is written again.
    if is_file(inner / part_files.METADATA) and not is_file(path):
        raise BidexError(f"{folder} holds a complete data set. Name another by --out, or delete it.")
    if is_file(path):
        before = stored_plan(folder)
        differ = sorted(name for name in before.keys() | plan.keys() if before.get(name) != plan.get(name))
        if differ:
            old, new = (shortened(stored.get(differ[0])) for stored in (before, plan))
            fault = f"{folder} is a recording that has not ended, with {differ[0]} {old}, not {new}"
            raise BidexError(f"{fault}. Run its own command to continue, or name another path by --out.")
        return True
    if inner.is_dir():
        remove_leftovers(inner)  # a killed collection may have left files
    if folder.exists() and any(folder.iterdir()) and not (inner.is_dir() and not any(inner.iterdir())):
        raise BidexError(f"{folder} exists and is not empty. Name another path by --out.")
    check_writable(path)
    return False


def finish(folder: Path, name: str, observations: Box, actions: Box, metadata: Json) -> None:
    """Complete a data set: write Minari's index over the parts of all processes, then the metadata.

    The spaces are those of one observation (d,) and action (a,). ``metadata`` is stored as our entry in Minari's
    metadata; it must contain ``tasks``, and this function adds ``left_out``. BidexError is raised if Minari does not
    accept ``name``, or if a part is damaged.
    """
    check_name(name)
    inner = folder / "data"
    parts = part_files.parts_of(inner)
    steps = [part_files.read_table(path)["steps"] for path in parts]
    part_files.write_main(inner, parts)
    ours = {"format": part_files.FORMAT, **metadata, "left_out": left_out(inner)}
    content = {
        "total_episodes": sum(map(len, steps)),
        "total_steps": int(sum(of_part.sum() for of_part in steps)),
        "data_format": "hdf5",
        "observation_space": _space(observations),
        "action_space": _space(actions),
        "dataset_id": name,
        "minari_version": _MINARI,
        "dataset_size": round(sum(path.stat().st_size for path in parts) / 1e6, 1),
        "algorithm_name": str(metadata.get("kind", "")),
        "requirements": [],
    }
    if metadata.get("gymnasium_id"):
        content["env_spec"] = gymnasium.spec(metadata["gymnasium_id"]).to_json()  # for Minari's recover_environment
    _write_metadata(inner, content, ours)
    (inner / part_files.RECORDING).unlink(missing_ok=True)


def adopt(inner: Path, folder: Path, name: str) -> None:
    """Publish the data in ``inner``, which a training run has recorded, as a data set ``name`` in ``folder``.

    The files become hard links, or copies if the file system cannot link. Raises BidexError if ``inner`` is not such a
    recording, and the same errors as ``claimed``.
    """
    check_name(name)
    with claimed(folder, plan := {"kind": "replay", "of": str(inner.resolve())}):
        begin(folder, plan)
        new = folder / "data"
        content = read_json(inner / part_files.METADATA, "a data set's metadata")
        if "bidex" not in content:
            raise BidexError(f"{inner} holds no recording of a run. Record during training: bidex-meta run --record N.")
        for path in [*part_files.parts_of(inner), inner / part_files.MAIN]:
            # A command that was killed or ran out of space may have left the file.
            (new / path.name).unlink(missing_ok=True)
            try:
                os.link(path, new / path.name)
            except OSError:
                shutil.copyfile(path, new / path.name)
        _write_metadata(new, content | {"dataset_id": name}, content["bidex"])
        (new / part_files.RECORDING).unlink()


def left_out(inner: Path) -> dict[str, int]:
    """Count the left-out transitions and episodes of all parts by reason."""
    counts: Counter[str] = Counter()
    for path in part_files.parts_of(inner):
        with part_files.reading(path) as file:
            counts.update({name: int(value) for name, value in file.attrs.items()})
    return dict(counts)


def _write_metadata(inner: Path, content: Json, ours: Json) -> None:
    write_atomic(inner / part_files.METADATA, lambda file: file.write(seals.sealed_text(content, ours)))


def _space(space: Box) -> str:
    entries = {"type": "Box", "dtype": str(np.dtype(space.dtype)), "shape": list(space.shape)}
    return json.dumps(entries | {"low": space.low.tolist(), "high": space.high.tolist()})


def estimated_bytes(steps: int, observation_size: int, action_size: int, episode_steps: float) -> int:
    """Estimate the bytes on the disk; ``episode_steps`` is the mean length of an episode."""
    episodes = math.ceil(steps / max(episode_steps, 1.0))
    own = 4 * observation_size + part_files.EPISODE_BYTES
    return steps * (4 * (observation_size + action_size + 1) + 2) + episodes * own

"""The files of a data set: parts of whole episodes, and the index that Minari reads.

::

    <name>/data/
        recording.json         the plan: written first, compared when the collection is resumed
        part-<p>-<n>.hdf5      part n of process p: episodes, and a table of them
        main_data.hdf5         Minari's file: episode_0, episode_1, ... as links into the parts
        metadata.json          Minari's entries, and ours under "bidex"; written last: it marks a complete data set

A part is written under a temporary name and then renamed, so a part is either complete, with its digest (``seals.py``),
or absent. Each episode is a group in Minari's layout: ``minari.load_dataset`` opens it, and no byte is stored twice.
"""

import io
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from bidex_meta.data import seals
from bidex_meta.errors import BidexError, one_line
from bidex_meta.runs.atomic import Json, sync_folder
from bidex_meta.utils.files import is_file

H5 = Any  # h5py's file, group, array or buffer; h5py is optional and has no types

MAIN = "main_data.hdf5"
METADATA = "metadata.json"
RECORDING = "recording.json"
FORMAT = 1  # raised when older code can no longer read the files
_PART = re.compile(r"part-(\d{1,4})-(\d{1,6})\.hdf5", re.ASCII)
EPISODE_BYTES = 4300  # overhead of an episode in HDF5 in bytes, measured with an instruction of 100 letters
ARRAYS = {"observations": "observations", "actions": "actions", "rewards": "rewards"}
ARRAYS |= {"terminations": "terminated", "truncations": "truncated"}
"""Minari's names of an episode's arrays, and ours."""
TABLE: dict[str, type] = dict.fromkeys(("steps", "task", "task_index", "row", "policy"), np.int64)
TABLE |= {"success": np.bool_, "broken": np.bool_, "return": np.float64, "return_unscaled": np.float64}
"""Columns of the table of a part's episodes. A further column, ``variation`` (episodes, v), is padded with NaN."""


@dataclass(frozen=True)
class Episode:
    """T transitions of one environment, from a start to an end."""

    observations: np.ndarray  # (T + 1, d), float32: the start, and the state after each transition
    actions: np.ndarray  # (T, a), float32, clipped to [-1, 1]
    rewards: np.ndarray  # (T,), float32, with the suite's scale of the class
    terminated: np.ndarray  # (T,), bool: true at most for the last transition
    truncated: np.ndarray  # (T,), bool: true at most for the last one: time was up, or physics broke next
    task: int = 0  # slot of the world
    task_name: str = ""  # name of the slot: a class, or ``Class/task``
    task_index: int = 0  # index of the task in the slot's pool; -1 for a new task, which the pool lacks
    variation: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (v,), float64: values that the task fixes
    success: bool = False  # by the suite's rule: the goal was met at any step, or held at the end
    broken: bool = False  # whether physics broke in the next transition, which is left out
    return_unscaled: float = 0.0  # sum of the rewards before the suite's scale
    row: int = 0  # environment of the process's world
    policy: int = 0  # number of the acting policy, from 0
    instruction: str = ""  # the task in words, without hidden parts; empty if the world has no sentences

    def __len__(self) -> int:
        """Return the number of transitions, T."""
        return len(self.rewards)


def hdf5() -> ModuleType:
    """Return the package ``h5py``; raise BidexError if ``h5py`` is not installed."""
    try:
        import h5py
    except ModuleNotFoundError:
        fault = "Expected h5py for data sets, but it is not installed"
        raise BidexError(f"{fault}. Install it: pip install 'bidex-meta[data]'.") from None
    return h5py


def parts_of(folder: Path, process: int | None = None) -> list[Path]:
    """List the part files in a folder ``data``, sorted by process and number.

    A part file holds a part of the data set's episodes. If ``process`` is given, only the files of this process are
    listed.
    """
    parts = [(int(match[1]), int(match[2]), path) for path in _files(folder) if (match := _PART.fullmatch(path.name))]
    return [path for owner, _, path in sorted(parts) if process in (None, owner)]


def part_path(folder: Path, process: int, number: int) -> Path:
    """Return the path of the file with part ``number`` of the episodes that ``process`` stores in a data set."""
    return folder / f"part-{process}-{number:05d}.hdf5"


def remove_parts(folder: Path, process: int, keep: int) -> None:
    """Delete the part files of a process with number ``keep`` or higher, and the half-written files of this process."""
    for path in _files(folder):
        match = _PART.fullmatch(path.name)
        if (match and int(match[1]) == process and int(match[2]) >= keep) or path.name.startswith(f".part-{process}-"):
            path.unlink()


def _files(folder: Path) -> Iterator[Path]:
    return folder.iterdir() if folder.is_dir() else iter(())


class _Disk(io.FileIO):
    """A file for HDF5 that stores the system's first error (``refused``) instead of raising it.

    If the error were raised, HDF5 would retry at each close, print tracebacks that nobody can catch, and crash as the
    process ends.
    """

    refused: OSError | None = None

    def write(self, data: H5, /) -> int:
        """Write all data."""
        left = memoryview(data)
        size = left.nbytes
        try:
            while len(left):
                left = left[super().write(left) :]
        except OSError as error:
            self.refused = self.refused or error
        return size

    def truncate(self, size: int | None = None, /) -> int:
        """Set the file's length."""
        try:
            return super().truncate(size)
        except OSError as error:
            self.refused = self.refused or error
            return size or 0


class SealedFile:
    """An HDF5 file that is being written; ``commit`` adds its digest, forces the file to the disk and renames it."""

    def __init__(self, path: Path) -> None:
        h5 = hdf5()
        self._path = path
        self._temporary = path.with_name(f".{path.name}")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._disk = _Disk(self._temporary, "w+")
        self._file: H5 = h5.File(self._disk, "w", userblock_size=seals.BLOCK)

    @contextmanager
    def writing(self) -> Iterator[H5]:
        """Yield h5py's file for writing; if the disk refuses a write, drop the file and raise OSError."""
        try:
            yield self._file
        finally:
            if (refused := self._disk.refused) is not None:
                self.abandon()
                raise OSError(refused.errno, refused.strerror, str(self._path))

    def commit(self) -> None:
        """Complete the file; raise the same errors as ``writing``."""
        with self.writing() as file:
            file.close()
        with self.writing():
            seal = seals.block(self._disk)
            self._disk.seek(0)
            self._disk.write(seal)
        os.fsync(self._disk.fileno())
        self._disk.close()
        os.replace(self._temporary, self._path)
        sync_folder(self._path.parent)

    def abandon(self) -> None:
        """Drop the file, unless it was committed."""
        if not self._disk.closed:
            with suppress(Exception):  # on a full disk HDF5 may read bytes that were never written
                self._file.close()
            self._disk.close()
            self._temporary.unlink(missing_ok=True)


class PartWriter:
    """A part of a data set that is being written; each added episode is written to the disk immediately.

    The file has a temporary name until ``commit``.
    """

    def __init__(self, path: Path) -> None:
        self._sealed = SealedFile(path)
        self._rows: list[Json] = []
        self._variations: list[np.ndarray] = []
        self.steps = 0

    def add(self, episode: Episode) -> None:
        """Write an episode; raise the same errors as ``SealedFile.writing``."""
        row = {name: getattr(episode, name) for name in TABLE if name not in ("steps", "return")}
        row |= {"steps": len(episode), "return": float(episode.rewards.astype(np.float64).sum())}
        named = {"total_steps": len(episode), "task_name": episode.task_name, "variation": episode.variation}
        named["instruction"] = episode.instruction
        with self._sealed.writing() as file:
            group = file.create_group(f"episode_{len(self._rows)}")
            for name, ours in ARRAYS.items():
                group.create_dataset(name, data=getattr(episode, ours))
            group.create_group("infos")  # Minari prints the keys of this group
            shown = ("task", "task_index", "policy", "success", "broken")
            group.attrs.update({name: row[name] for name in shown} | named)
        self._rows.append(row)
        self._variations.append(np.asarray(episode.variation, np.float64))
        self.steps += len(episode)

    def commit(self, counts: dict[str, int]) -> None:
        """Complete the part file, and store ``counts`` in it: the left-out transitions and episodes by reason."""
        width = max(map(len, self._variations), default=0)
        variations = np.full((len(self._rows), width), np.nan)
        for row, variation in zip(variations, self._variations, strict=True):
            row[: len(variation)] = variation
        with self._sealed.writing() as file:
            table = file.create_group("table")
            for name, kind in TABLE.items():
                table.create_dataset(name, data=np.array([row[name] for row in self._rows], kind))
            table.create_dataset("variation", data=variations)
            file.attrs.update(counts)
        self._sealed.commit()

    def abandon(self) -> None:
        """Drop the part, unless it was committed."""
        self._sealed.abandon()


def write_main(folder: Path, parts: Iterable[Path]) -> None:
    """Write Minari's file: a link to every episode of the parts, in the order of the parts."""
    main = SealedFile(folder / MAIN)
    number = 0
    h5 = hdf5()
    try:
        with main.writing() as file:
            for path in parts:
                for inner in range(len(read_table(path)["steps"])):
                    file[f"episode_{number}"] = h5.ExternalLink(path.name, f"/episode_{inner}")
                    number += 1
        main.commit()
    finally:
        main.abandon()


@contextmanager
def reading(path: Path) -> Iterator[H5]:
    """Yield an open HDF5 file for reading.

    Raises BidexError if there is no file, or if the data that the ``with`` block reads are damaged.
    """
    h5 = hdf5()
    if not is_file(path):
        raise BidexError(f"Expected a part of a data set at {path}, found none. Record it again.")
    try:
        with h5.File(path, "r") as file:
            yield file
    except BidexError:
        raise
    except Exception as error:  # h5py raises many kinds; a group instead of an array lacks an array's attributes
        reason = one_line(str(error).strip("'\"").split("(")[-1].rstrip(")"))[:200] or type(error).__name__
        fault = f"{path} is damaged or no part of a data set ({reason})"
        raise BidexError(f"{fault}. Delete it and record it again.") from None


def read_table(path: Path) -> dict[str, np.ndarray]:
    """Read the table of a part's episodes: columns (episodes,), and ``variation`` (episodes, v).

    Raises BidexError if the part is damaged or missing.
    """
    with reading(path) as file:
        table = {name: file["table"][name] for name in (*TABLE, "variation")}
        rows = table["steps"].shape[:1]
        for name, column in table.items():
            width, kind = (1, "f") if name == "variation" else (0, np.dtype(TABLE[name]).kind)
            if column.shape[:1] != rows or len(column.shape) != 1 + width or column.dtype.kind != kind:
                raise ValueError(f"column {name} of shape {list(column.shape)} and type {column.dtype}")
        return {name: column[()] for name, column in table.items()}

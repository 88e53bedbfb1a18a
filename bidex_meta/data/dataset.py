"""A data set as it is read: metadata, episodes, and all transitions as tensors."""

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bidex_meta.data import foreign, part_files
from bidex_meta.data.episode import Episode
from bidex_meta.errors import BidexError, unknown_name
from bidex_meta.memory import check_memory
from bidex_meta.reading import TABLE, TEXT, check, expanded, is_file, read_json, whole

if TYPE_CHECKING:
    from torch import Tensor

_FOLDER = "BIDEX_DATA"
_RULES = {"total_episodes": whole(0), "total_steps": whole(0), "dataset_id": TEXT, "bidex": TABLE}
_MOST_LOOKED_AT = 5000


def data_folder() -> Path:
    """Where data sets lie: the folder that BIDEX_DATA names, else ``data`` in the working folder."""
    return expanded(os.environ.get(_FOLDER) or "data")


def dataset_names(folder: Path | None = None) -> list[str]:
    """Names of the complete data sets in a folder (``data_folder()``), such as ``CatchUnderarm/random-v0``."""
    folder, found = data_folder() if folder is None else folder, []
    for number, path in enumerate(folder.glob("**/data/" + part_files.METADATA) if folder.is_dir() else ()):
        if number >= _MOST_LOOKED_AT:
            break
        found.append(path.parent.parent.relative_to(folder).as_posix())
    return sorted(found)


def open_dataset(name_or_path: str | Path) -> "Dataset":
    """A data set by its name in ``data_folder()``, or by its folder's path.

    Args:
        name_or_path: ``CatchUnderarm/random-v0``, or any folder that holds ``data/metadata.json``.

    Raises:
        BidexError: There is none, its recording has not ended, it is damaged, or h5py is not installed.
    """
    named = expanded(name_or_path)
    for folder in (named, data_folder() / named):
        for inner in (folder / "data", folder):
            if is_file(inner / part_files.METADATA):
                return _opened(inner)
            if is_file(inner / part_files.RECORDING):
                raise BidexError(f"The recording of {folder} has not ended. Give its command again to go on.")
    raise unknown_name("data set", str(name_or_path), dataset_names())


def _opened(folder: Path) -> "Dataset":
    path = folder / part_files.METADATA
    content = read_json(path, "a data set's metadata")
    check(content, _RULES, path, ("total_episodes", "total_steps"))
    if content.get("data_format", "hdf5") != "hdf5":
        raise BidexError(f"{path}: expected the format hdf5, got {content['data_format']!r}. Convert it with Minari.")
    ours = content.get("bidex", {})
    if ours.get("format", part_files.FORMAT) != part_files.FORMAT:
        raise BidexError(
            f"{path}: expected format {part_files.FORMAT}, got {ours['format']!r}. Use a newer bidex-meta."
        )
    return Dataset(folder, content)


@dataclass(frozen=True)
class _Place:
    """Where episodes stand: a file, and the number of the first one in it."""

    path: Path
    count: int


class Dataset:
    """Whole episodes on disk. Made by ``open_dataset``; nothing but small tables stays in memory.

    Attributes:
        folder: The folder ``data`` of the data set.
        content: All of ``metadata.json``, Minari's entries too.
        metadata: Ours of it: ``suite`` and ``suite_version``, or ``task``; ``tasks`` (names of the slots), ``kind``,
            ``policies``, ``seed``, ``versions``, ``commit``, ``references`` ({class: {random, zero, expert}}) and
            ``left_out``. Of a data set from elsewhere only ``tasks`` and ``kind``.
    """

    def __init__(self, folder: Path, content: dict[str, Any]) -> None:
        self.folder, self.content = folder, content
        self.name: str = content.get("dataset_id", folder.parent.name)
        self.metadata: dict[str, Any] = content.get("bidex") or {"tasks": [self.name], "kind": "outside"}
        self._parts = part_files.parts_of(folder) if "bidex" in content else []

    @cached_property
    def table(self) -> dict[str, np.ndarray]:
        """A row for every episode, in the order of ``episodes()``: columns of ``part_files.TABLE``, ``variation``.

        Raises:
            BidexError: Parts are missing or damaged.
        """
        if "bidex" not in self.content:
            return self._outside_table()
        tables = [part_files.read_table(path) for path in self._parts]
        found = {name: _joined([table[name] for table in tables]) for name in (*part_files.TABLE, "variation")}
        told = self.content["total_episodes"], self.content["total_steps"]
        there = len(found["steps"]), int(found["steps"].sum())
        if told != there:
            raise BidexError(
                f"{self.folder}: expected {told[0]} episodes of {told[1]} steps, found {there[0]} of {there[1]}. Parts "
                "are missing: record it again, or bring them back."
            )
        return found

    @property
    def num_episodes(self) -> int:
        """Episodes."""
        return self.content["total_episodes"]

    @property
    def num_steps(self) -> int:
        """Transitions over all episodes."""
        return self.content["total_steps"]

    @property
    def observation_size(self) -> int:
        """Entries of an observation, d."""
        return self._sizes[0]

    @property
    def action_size(self) -> int:
        """Actions, a."""
        return self._sizes[1]

    @property
    def action_bounds(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Least and largest actions, (a,) each, of a data set from elsewhere; None: -1 and 1, as all recorded here.

        Raises:
            BidexError: Its metadata do not tell finite ones.
        """
        return None if "bidex" in self.content else foreign.action_bounds(self.content, self.name, self.action_size)

    @cached_property
    def _sizes(self) -> tuple[int, int]:
        first = next(self.episodes(), None)
        if first is None:
            raise BidexError(f"{self.folder} holds no episode. Record it again.")
        return first.observations.shape[1], first.actions.shape[1]

    def episodes(self) -> Iterator[Episode]:
        """All episodes, read one by one.

        Raises:
            BidexError: A file is damaged, or observations or actions of a data set from elsewhere are not flat.
        """
        h5, names, number = part_files.hdf5(), self.metadata["tasks"], 0
        foreign.check_spaces(self.content, self.name)
        for place in self._places():
            try:
                with h5.File(place.path, "r") as file:
                    for inner in range(place.count):
                        group = file[f"episode_{inner}"]
                        arrays = {
                            ours: foreign.numbers(group[name], name, self.name)
                            for name, ours in part_files.ARRAYS.items()
                        }
                        yield Episode(**arrays, **self._told(number, names))
                        number += 1
            except (OSError, KeyError) as error:
                raise part_files.damaged(place.path, error) from None

    def _places(self) -> list[_Place]:
        if "bidex" not in self.content:
            return [_Place(self.folder / part_files.MAIN, self.num_episodes)]
        return [_Place(path, len(part_files.read_table(path)["steps"])) for path in self._parts]

    def _told(self, number: int, names: list[str]) -> dict[str, Any]:
        row = {name: column[number].item() for name, column in self.table.items() if name != "variation"}
        variation = self.table["variation"][number]
        told = ("task", "task_index", "success", "broken", "return_unscaled", "row", "policy")
        return {name: row[name] for name in told} | {
            "task_name": names[row["task"]],
            "variation": variation[~np.isnan(variation)],
        }

    def transition_bytes(self) -> int:
        """Bytes that ``transitions`` takes."""
        return self.num_steps * (4 * (2 * self.observation_size + self.action_size + 1) + 1 + 8)

    def transitions(self) -> "dict[str, Tensor]":
        """All transitions in memory, in the order of the episodes, each tensor contiguous.

        Returns:
            ``observations`` (N, d), ``actions`` (N, a), ``rewards`` (N,), ``next_observations`` (N, d), all float32;
            ``terminated`` (N,), bool: where a value must not be taken of the next observation; ``task`` (N,), int64.

        Raises:
            BidexError: They do not fit into the memory that is free.
        """
        import torch

        told = f"The {self.num_steps:,} transitions of {self.name}"
        check_memory(self.transition_bytes(), told, "Record fewer, or free memory.")
        n, d, a = self.num_steps, self.observation_size, self.action_size
        found = {
            "observations": torch.empty(n, d),
            "actions": torch.empty(n, a),
            "rewards": torch.empty(n),
            "next_observations": torch.empty(n, d),
            "terminated": torch.empty(n, dtype=torch.bool),
            "task": torch.empty(n, dtype=torch.int64),
        }
        views = {name: tensor.numpy() for name, tensor in found.items()}
        start = 0
        for episode in self.episodes():
            where = slice(start, start + len(episode))
            views["observations"][where] = episode.observations[:-1]
            views["next_observations"][where] = episode.observations[1:]
            for name in ("actions", "rewards", "terminated", "task"):
                views[name][where] = getattr(episode, name)
            start = where.stop
        return found

    def _outside_table(self) -> dict[str, np.ndarray]:
        """The same of a Minari data set that was not recorded here: one task, no variation."""
        h5, n = part_files.hdf5(), self.num_episodes
        found: dict[str, np.ndarray] = {name: np.zeros(n, kind) for name, kind in part_files.TABLE.items()}
        try:
            with h5.File(self.folder / part_files.MAIN, "r") as file:
                for number in range(n):
                    rewards = file[f"episode_{number}"]["rewards"][()]
                    found["steps"][number], found["return"][number] = len(rewards), rewards.sum(dtype=np.float64)
        except (OSError, KeyError) as error:
            raise part_files.damaged(self.folder / part_files.MAIN, error) from None
        return found | {"return_unscaled": found["return"].copy(), "variation": np.zeros((n, 0))}


def _joined(columns: list[np.ndarray]) -> np.ndarray:
    """Columns of several parts in one; variations are filled up with NaN to the widest."""
    if not columns:
        return np.zeros(0)
    if columns[0].ndim == 1:
        return np.concatenate(columns)
    width = max(column.shape[1] for column in columns)
    return np.concatenate([np.pad(c, ((0, 0), (0, width - c.shape[1])), constant_values=np.nan) for c in columns])


def valid_name(name: str) -> bool:
    """Whether Minari takes a name: words of letters, digits, - and _, parted by /, and a version such as -v0."""
    return re.fullmatch(r"(?:[-\w]+/)*[-\w]+-v\d{1,4}", name, re.ASCII) is not None

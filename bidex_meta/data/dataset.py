"""A data set as it is read: metadata, episodes, and all transitions as tensors."""

import math
import os
import re
from collections.abc import Iterator
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bidex_meta.data import foreign, part_files, seals
from bidex_meta.data.episode import Episode
from bidex_meta.errors import BidexError, shortened, unknown_name
from bidex_meta.memory import check_memory
from bidex_meta.reading import (
    TABLE,
    TEXT,
    Rule,
    check,
    choice,
    expanded,
    is_file,
    number,
    read_bytes,
    read_json,
    whole,
)

if TYPE_CHECKING:
    from torch import Tensor

_FOLDER = "BIDEX_DATA"
_RULES = {"total_episodes": whole(0), "total_steps": whole(0), "dataset_id": TEXT, "bidex": TABLE}
_TEXTS = Rule("a list of texts", lambda value: isinstance(value, list) and value != [] and all(map(TEXT.fits, value)))
_TABLES = Rule("a list of tables", lambda value: isinstance(value, list) and all(map(TABLE.fits, value)))
_RETURN = number(-1e300, 1e300).or_none()
_OURS = {
    "format": whole(1, part_files.FORMAT),
    "tasks": _TEXTS,
    "kind": TEXT,
    "policies": _TABLES,
    "left_out": whole(0).each(),
    "references": TABLE,
    "reward_scales": number(1e-300, 1e300).each(),
    "hides_goals": Rule("true or false", lambda value: isinstance(value, bool)),
    "base": choice("own", "moving", "fixed").or_none(),
    "suite": TEXT.or_none(),
    "task": TEXT.or_none(),
    "object": TEXT.or_none(),
    "points": whole(0).or_none(),
    "seed": whole(0).or_none(),
    "observation_groups": Rule("a list of names and index ranges", lambda value: _are_groups(value)),
}
"""Of ours in the metadata, what is read again."""
_MOST_LOOKED_AT = 5000
_LOOKED_AT = 64_000_000
"""Bytes of parts that are held to their digests when a data set is opened, about: 0.03 s. The others follow when their
episodes are read."""


def data_folder() -> Path:
    """Where data sets lie: the folder that BIDEX_DATA names, else ``data`` in the working folder."""
    return expanded(os.environ.get(_FOLDER) or "data")


def dataset_names(folder: Path | None = None) -> list[str]:
    """Names of the complete data sets in a folder (``data_folder()``), such as ``CatchUnderarm/random-v0``."""
    folder = data_folder() if folder is None else folder
    found = islice(folder.glob("**/data/" + part_files.METADATA) if folder.is_dir() else (), _MOST_LOOKED_AT)
    return sorted(path.parent.parent.relative_to(folder).as_posix() for path in found)


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
    path, what = folder / part_files.METADATA, "a data set's metadata"
    sealed, content = seals.check_text(path, read_bytes(path, what)), read_json(path, what)
    check(content, _RULES, path, ("total_episodes", "total_steps"))
    if content.get("data_format", "hdf5") != "hdf5":
        raise BidexError(
            f"{path}: expected the format hdf5, got {shortened(content['data_format'])}. Convert it with Minari."
        )
    if "bidex" in content:
        ours = content["bidex"]
        if whole(part_files.FORMAT + 1).fits(ours.get("format")):
            raise BidexError(
                f"{path}: expected format {part_files.FORMAT}, got {ours['format']}. Use a newer bidex-meta."
            )
        check(ours, _OURS, path, ("tasks", "kind"), "bidex.")
        for name, row in ours.get("references", {}).items():
            rules = {"random": number(-1e300, 1e300), "zero": _RETURN, "expert": _RETURN}
            check(row, rules, path, ("random",), f"bidex.references.{name}.")
    return Dataset(folder, content, sealed)


def _are_groups(value: Any) -> bool:
    """Whether it is [name, index ranges] of each group, as ``_sizes`` and whoever reads them take for granted."""
    try:
        return all(
            isinstance(name, str) and parts and all(whole(0).fits(a) and whole(a + 1).fits(b) for a, b in parts)
            for name, parts in value
        )
    except (TypeError, ValueError):
        return False


class Dataset:
    """Whole episodes on disk. Made by ``open_dataset``; nothing but small tables stays in memory.

    Attributes:
        folder: The folder ``data`` of the data set.
        content: All of ``metadata.json``, Minari's entries too.
        metadata: Ours of it: ``suite`` and ``suite_version``, or ``task``; ``tasks`` (names of the slots), ``kind``,
            ``policies``, ``seed``, ``versions``, ``commit``, ``references`` ({class: {random, zero, expert}}) and
            ``left_out``. Of a data set from elsewhere only ``tasks`` and ``kind``.
    """

    def __init__(self, folder: Path, content: dict[str, Any], sealed: bool = False) -> None:
        self.folder, self.content = folder, content
        self.name: str = content.get("dataset_id", folder.parent.name)
        self.metadata: dict[str, Any] = content.get("bidex") or {"tasks": [self.name], "kind": "outside"}
        self._paths = part_files.parts_of(folder) if "bidex" in content else [folder / part_files.MAIN]
        self._sealed = {folder / part_files.METADATA: sealed}

    def check_digests(self) -> list[str]:
        """Holds every file to its digest, reading all of them; names of those without one.

        Raises:
            BidexError: One has changed since it was written.
        """
        if "bidex" not in self.content:
            return [part_files.METADATA, part_files.MAIN]
        for path in (*self._paths, self.folder / part_files.MAIN):
            self._check_digest(path)
        return [path.name for path, sealed in self._sealed.items() if not sealed]

    def _check_digest(self, path: Path) -> None:
        if path not in self._sealed:
            self._sealed[path] = seals.check_file(path)

    @cached_property
    def _tables(self) -> list[dict[str, np.ndarray]]:
        """The table of each of ``_paths``."""
        if "bidex" not in self.content:
            return [self._outside_table()]
        size = sum(path.stat().st_size for path in self._paths if is_file(path))
        for path in self._paths[:: math.ceil(size / _LOOKED_AT) or 1]:
            self._check_digest(path)
        return [part_files.read_table(path) for path in self._paths]

    @cached_property
    def table(self) -> dict[str, np.ndarray]:
        """A row for every episode, in the order of ``episodes()``: columns of ``part_files.TABLE``, ``variation``.

        Raises:
            BidexError: Parts are missing or damaged.
        """
        found = {name: _joined([table[name] for table in self._tables]) for name in (*part_files.TABLE, "variation")}
        own = self.num_episodes, self.num_steps
        there = len(found["steps"]), int(found["steps"].sum())
        if own != there:
            raise BidexError(
                f"{self.folder}: expected {own[0]} episodes of {own[1]} steps, found {there[0]} of {there[1]}. Parts "
                "are missing: record it again, or bring them back."
            )
        slots = len(self.metadata["tasks"])
        if ((found["task"] < 0) | (found["task"] >= slots)).any():
            raise BidexError(f"{self.folder}: expected tasks from 0 to {slots - 1}, found others. Record it again.")
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
        groups = self.metadata.get("observation_groups", ())
        shown = max((stop for _, ranges in groups for _, stop in ranges), default=0)
        if shown > (size := first.observations.shape[1]):
            raise BidexError(
                f"{self.folder}: expected {shown} entries of an observation, found {size}. Record it again."
            )
        return size, first.actions.shape[1]

    def episodes(self) -> Iterator[Episode]:
        """All episodes, read one by one.

        Raises:
            BidexError: A file is damaged, arrays are not as long as its table says, or observations or actions of a
                data set from elsewhere are not flat.
        """
        foreign.check_spaces(self.content, self.name)
        number, sizes = 0, None
        for path, table in zip(self._paths, self._tables, strict=True):
            if "bidex" in self.content:
                self._check_digest(path)
            with part_files.reading(path) as file:
                for inner in range(len(table["steps"])):
                    episode = self._episode(file[f"episode_{inner}"], number)
                    found = episode.observations.shape[1], episode.actions.shape[1]
                    sizes = sizes or found
                    if found != sizes:
                        raise BidexError(
                            f"{path}: expected {sizes[0]} observations and {sizes[1]} actions a step, as in the "
                            f"first episode, got {found[0]} and {found[1]} in episode {number}. Record it again."
                        )
                    yield episode
                    number += 1

    def _episode(self, group: Any, number: int) -> Episode:
        """An episode of HDF5's group, its arrays as long as the table says."""
        steps, arrays = int(self.table["steps"][number]), {}
        for name, ours in part_files.ARRAYS.items():
            length = steps + (name == "observations")
            arrays[ours] = foreign.numbers(group[name], name, self.name, length)
        return Episode(**arrays, **self._told(number, self.metadata["tasks"]))

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
            "observations": torch.zeros(n, d),
            "actions": torch.zeros(n, a),
            "rewards": torch.zeros(n),
            "next_observations": torch.zeros(n, d),
            "terminated": torch.zeros(n, dtype=torch.bool),
            "task": torch.zeros(n, dtype=torch.int64),
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
        steps, returns = [], []
        with part_files.reading(self.folder / part_files.MAIN) as file:
            for number in range(self.num_episodes):
                rewards = foreign.numbers(file[f"episode_{number}"]["rewards"], "rewards", self.name)
                steps.append(len(rewards))
                returns.append(rewards.sum(dtype=np.float64))
        found = {name: np.zeros(len(steps), kind) for name, kind in part_files.TABLE.items()}
        found["steps"][:], found["return"][:] = steps, returns
        return found | {"return_unscaled": found["return"].copy(), "variation": np.zeros((len(steps), 0))}


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

"""Read a data set: metadata, episodes, and all transitions as tensors."""

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from msgspec import Meta

from bidex_meta.data import other_formats, part_files, seals
from bidex_meta.data.part_files import H5, Episode, Json
from bidex_meta.errors import BidexError, shortened, unknown_name
from bidex_meta.rules import V1, Rules
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.files import expanded, is_file, read_bytes, read_json
from bidex_meta.utils.memory import check_memory
from bidex_meta.utils.validation import Finite, Positive, Seed, Text, Whole, parse

if TYPE_CHECKING:
    from torch import Tensor

_Range = tuple[Whole, Whole]
_MOST_LISTED = 5000
_OF_EPISODE = ("task", "task_index", "success", "broken", "return_unscaled", "row", "policy")
_CHECKED_AT_OPENING = 64_000_000
"""Approximate bytes of the parts whose digests are checked at opening (0.03 s); reading episodes checks the others."""


@dataclass(frozen=True)
class _Reference:
    """Mean returns of a class's reference policies, before the suite's reward scale; see ``evaluation.references``."""

    random: Finite | None = None
    zero: Finite | None = None
    expert: Finite | None = None
    episode_steps: Whole | None = None


@dataclass(frozen=True)
class _Collected:
    """The fields of our metadata entry ``bidex`` that are read; the entry may hold further fields."""

    tasks: Annotated[list[Text], Meta(min_length=1)]
    kind: Text
    format: Annotated[int, Meta(ge=1)] = part_files.FORMAT
    policies: list[dict[str, object]] = field(default_factory=list)
    left_out: dict[str, Whole] = field(default_factory=dict)
    references: dict[str, _Reference] = field(default_factory=dict)
    reward_scales: dict[str, Positive] = field(default_factory=dict)
    physics: dict[str, Text] = field(default_factory=dict)
    rules: Rules = V1
    hides_goals: bool = False
    base: Literal["own", "moving", "fixed"] | None = None
    suite: Text | None = None
    task: Text | None = None
    object: Text | None = None
    points: Whole | None = None
    tasks_per_class: Whole | None = None
    seed: Seed | None = None
    observation_groups: list[tuple[str, Annotated[list[_Range], Meta(min_length=1)]]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.format > part_files.FORMAT:
            raise BidexError(f"format: expected {part_files.FORMAT}, got {self.format}. Use a newer bidex-meta.")
        for name, ranges in self.observation_groups:
            if any(start >= stop for start, stop in ranges):
                raise BidexError(f"observation_groups: {shortened(name)}: expected rising ranges, got {ranges[:3]}.")


@dataclass(frozen=True)
class _Metadata:
    """The entries of ``metadata.json`` that are read: Minari's entries, and ours."""

    total_episodes: Whole
    total_steps: Whole
    data_format: Literal["hdf5"] = "hdf5"
    dataset_id: Text = "unnamed"
    bidex: _Collected | None = None


def data_folder() -> Path:
    """Return the folder of data sets: the folder that BIDEX_DATA names, else ``data`` in the working folder."""
    return expanded(os.environ.get("BIDEX_DATA") or "data")


@checked_arguments
def dataset_names(folder: Path | None = None) -> list[str]:
    """List the names, such as ``CatchUnderarm/random-v0``, of complete data sets.

    ``folder`` is the folder that is searched; None: ``data_folder()``.
    """
    if folder is None:
        folder = data_folder()
    complete = islice(folder.glob("**/data/" + part_files.METADATA) if folder.is_dir() else (), _MOST_LISTED)
    return sorted(path.parent.parent.relative_to(folder).as_posix() for path in complete)


@checked_arguments
def open_dataset(name_or_path: str | Path) -> "Dataset":
    """Open a data set by name in ``data_folder()`` or by path.

    Raises BidexError if the data set is missing, incomplete or damaged.
    """
    named = expanded(name_or_path)
    for folder in (named, data_folder() / named):
        for inner in (folder / "data", folder):
            path = inner / part_files.METADATA
            if is_file(path):
                sealed = seals.check_text(path, read_bytes(path, "a data set's metadata"))
                content = read_json(path, "a data set's metadata")
                parse(content, _Metadata, str(path))
                return Dataset(inner, content, sealed)
            if is_file(inner / part_files.RECORDING):
                raise BidexError(f"The recording of {folder} has not ended. Run its command again to continue.")
    raise unknown_name("data set", str(name_or_path), dataset_names())


class Dataset:
    """A data set of whole episodes on disk, from ``open_dataset``; only small tables stay in memory.

    ``folder`` is the folder of the files (the subfolder ``data``). ``content`` is all of ``metadata.json``.
    ``metadata`` is the entry ``bidex`` in it, which this library adds
    (``bidex_meta.experiments.run_data.dataset_metadata``). If a data set has no such entry, ``metadata`` has only
    ``tasks`` and ``kind``.
    """

    def __init__(self, folder: Path, content: Json, sealed: bool = False) -> None:
        self.folder = folder
        self.content = content
        self.num_episodes: int = content["total_episodes"]
        self.num_steps: int = content["total_steps"]
        self.name: str = content.get("dataset_id", folder.parent.name)
        self.metadata: Json = content.get("bidex") or {"tasks": [self.name], "kind": "outside"}
        if "bidex" in content:
            self._paths = part_files.parts_of(folder)
        else:
            self._paths = [folder / part_files.MAIN]
        self._sealed = {folder / part_files.METADATA: sealed}

    def check_digests(self) -> list[str]:
        """Read all files and return the names of files without a digest; raise BidexError if a file has changed."""
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
        if "bidex" not in self.content:
            return [self._outside_table()]
        size = sum(path.stat().st_size for path in self._paths if is_file(path))
        for path in self._paths[:: math.ceil(size / _CHECKED_AT_OPENING) or 1]:
            self._check_digest(path)
        return [part_files.read_table(path) for path in self._paths]

    @cached_property
    def table(self) -> dict[str, np.ndarray]:
        """Return the table of all episodes: a dict from the name of a column to an array with an entry per episode.

        The columns are those of ``part_files.TABLE``, and ``variation``, the values that the task fixes. Raises
        BidexError if files are damaged or missing.
        """
        columns = {name: _joined([table[name] for table in self._tables]) for name in (*part_files.TABLE, "variation")}
        episodes = len(columns["steps"])
        steps = int(columns["steps"].sum())
        if (self.num_episodes, self.num_steps) != (episodes, steps):
            fault = f"expected {self.num_episodes} episodes of {self.num_steps} steps, found {episodes} of {steps}"
            raise BidexError(f"{self.folder}: {fault}. Parts are missing: record it again, or bring them back.")
        slots = len(self.metadata["tasks"])
        if ((columns["task"] < 0) | (columns["task"] >= slots)).any():
            raise BidexError(f"{self.folder}: expected tasks from 0 to {slots - 1}, found others. Record it again.")
        return columns

    @property
    def observation_size(self) -> int:
        """Return the number of entries of an observation, d."""
        return self._sizes[0]

    @property
    def action_size(self) -> int:
        """Return the number of entries of an action, a."""
        return self._sizes[1]

    @property
    def action_bounds(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the lower and upper bounds of actions, (a,) each; None if bidex-meta recorded the data (bounds ±1).

        Raises BidexError unless all bounds are finite and upper bounds are above lower bounds.
        """
        if "bidex" in self.content:
            return None
        return other_formats.action_bounds(self.content, self.name, self.action_size)

    @cached_property
    def _sizes(self) -> tuple[int, int]:
        first = next(self.episodes(), None)
        if first is None:
            raise BidexError(f"{self.folder} holds no episode. Record it again.")
        groups = self.metadata.get("observation_groups", ())
        shown = 0
        for _, ranges in groups:
            shown = max(shown, *(stop for _, stop in ranges))
        if shown > (size := first.observations.shape[1]):
            fault = f"expected {shown} entries of an observation, found {size}"
            raise BidexError(f"{self.folder}: {fault}. Record it again.")
        return size, first.actions.shape[1]

    def episodes(self) -> Iterator[Episode]:
        """Read all episodes one by one.

        Raises BidexError if a file is damaged, or observations or actions are not flat.
        """
        other_formats.check_spaces(self.content, self.name)
        number = 0
        sizes = None
        for path, table in zip(self._paths, self._tables, strict=True):
            if "bidex" in self.content:
                self._check_digest(path)
            with part_files.reading(path) as file:
                for inner in range(len(table["steps"])):
                    episode = self._episode(file[f"episode_{inner}"], number)
                    own = episode.observations.shape[1], episode.actions.shape[1]
                    sizes = sizes or own
                    if own != sizes:
                        raise BidexError(
                            f"{path}: expected {sizes[0]} observations and {sizes[1]} actions a step, as in the "
                            f"first episode, got {own[0]} and {own[1]} in episode {number}. Record it again."
                        )
                    yield episode
                    number += 1

    def _episode(self, group: H5, number: int) -> Episode:
        row = {name: column[number].item() for name, column in self.table.items() if name != "variation"}
        arrays = {}
        for name, ours in part_files.ARRAYS.items():
            length = row["steps"] + (name == "observations")
            arrays[ours] = other_formats.numbers(group[name], name, self.name, length)
        variation = self.table["variation"][number]
        return Episode(
            **arrays,
            **{name: row[name] for name in _OF_EPISODE},
            task_name=self.metadata["tasks"][row["task"]],
            variation=variation[~np.isnan(variation)],
            instruction=str(group.attrs.get("instruction", "")),
        )

    def transition_bytes(self) -> int:
        """Return the bytes of memory that ``transitions`` takes."""
        return self.num_steps * (4 * (2 * self.observation_size + self.action_size + 1) + 1 + 8)

    def transitions(self) -> "dict[str, Tensor]":
        """Load all transitions into memory, in the order of the episodes, as contiguous tensors.

        ``observations`` (N, d), ``actions`` (N, a), ``rewards`` (N,) and ``next_observations`` (N, d) are float32;
        ``task`` (N,) is int64. ``terminated`` (N,), bool, marks transitions whose next observation must not be
        bootstrapped from. BidexError is raised if the tensors do not fit into the free memory, or if some of their
        numbers are not finite.
        """
        import torch

        n = self.num_steps
        d = self.observation_size
        a = self.action_size
        check_memory(self.transition_bytes(), f"The {n:,} transitions of {self.name}", "Record fewer, or free memory.")
        tensors = {
            "observations": torch.zeros(n, d),
            "actions": torch.zeros(n, a),
            "rewards": torch.zeros(n),
            "next_observations": torch.zeros(n, d),
            "terminated": torch.zeros(n, dtype=torch.bool),
            "task": torch.zeros(n, dtype=torch.int64),
        }
        views = {name: tensor.numpy() for name, tensor in tensors.items()}
        start = 0
        for number, episode in enumerate(self.episodes()):
            self.check_finite(number, episode.observations, episode.actions, episode.rewards)
            where = slice(start, start + len(episode))
            now = episode.observations[:-1]
            after = episode.observations[1:]
            views["observations"][where] = now
            views["next_observations"][where] = after
            for name in ("actions", "rewards", "terminated", "task"):
                views[name][where] = getattr(episode, name)
            start = where.stop
        return tensors

    def check_finite(self, number: int, observations: np.ndarray, actions: np.ndarray, rewards: np.ndarray) -> None:
        """Raise BidexError if episode ``number`` has observations, actions or rewards that are not finite."""
        for name, values in {"observations": observations, "actions": actions, "rewards": rewards}.items():
            if not np.isfinite(values).all():
                raise BidexError(
                    f"{self.name}: expected {name} that are finite as float32, got others in episode {number}. "
                    "Leave it out, or record it again."
                )

    def _outside_table(self) -> dict[str, np.ndarray]:
        steps = []
        returns = []
        with part_files.reading(self.folder / part_files.MAIN) as file:
            for number in range(self.num_episodes):
                rewards = other_formats.numbers(file[f"episode_{number}"]["rewards"], "rewards", self.name)
                steps.append(len(rewards))
                returns.append(rewards.sum(dtype=np.float64))
        table = {name: np.zeros(len(steps), kind) for name, kind in part_files.TABLE.items()}
        table["steps"][:] = steps
        table["return"][:] = returns
        return table | {"return_unscaled": table["return"].copy(), "variation": np.zeros((len(steps), 0))}


def _joined(columns: list[np.ndarray]) -> np.ndarray:
    """Concatenate a column of several tables.

    A column with several values per episode (``variation``) is padded with NaN to the widest of them.
    """
    if not columns:
        return np.zeros(0)
    if columns[0].ndim == 1:
        return np.concatenate(columns)
    width = max(column.shape[1] for column in columns)
    return np.concatenate([np.pad(c, ((0, 0), (0, width - c.shape[1])), constant_values=np.nan) for c in columns])

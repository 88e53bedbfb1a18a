"""A data set as it is written: parts that are there wholly or not at all, then the index."""

import json
import math
import os
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box

from bidex_meta.data import part_files
from bidex_meta.data.dataset import valid_name
from bidex_meta.data.episode import Episode
from bidex_meta.errors import BidexError
from bidex_meta.reading import is_file, read_json
from bidex_meta.record.atomic import check_writable, remove_leftovers, write_atomic, write_json

_MINARI = "0.5.0"
"""The version of Minari whose layout is written."""


class DatasetWriter:
    """Writes episodes of one process into the parts of a data set.

    Args:
        folder: The data set's folder; its name within the data folder is how it is opened.
        process: Number of this process; each has parts of its own.
        keep: Parts of this process that stay: those that the state knows from which the recording goes on.

    Attributes:
        parts: How many this process has committed.
        left_out: Counts, by reason, of what was not stored since the last commit; whoever records adds to it.
    """

    def __init__(self, folder: Path, process: int = 0, keep: int = 0) -> None:
        self.folder, self.process, self.parts = folder / "data", process, keep
        self.left_out: Counter[str] = Counter()
        part_files.hdf5()
        self.folder.mkdir(parents=True, exist_ok=True)
        part_files.remove_parts(self.folder, process, keep)
        self._part: part_files.PartWriter | None = None

    @property
    def open_steps(self) -> int:
        """Transitions that are not committed yet."""
        return 0 if self._part is None else self._part.steps

    def add(self, episode: Episode) -> None:
        """Writes an episode; it is lost unless ``commit`` follows."""
        if self._part is None:
            self._part = part_files.PartWriter(part_files.part_path(self.folder, self.process, self.parts))
        self._part.add(episode)

    def commit(self) -> None:
        """Makes a part of what was added since the last time; nothing where nothing was."""
        if self._part is None and not self.left_out:
            return
        part = self._part or part_files.PartWriter(part_files.part_path(self.folder, self.process, self.parts))
        part.commit(dict(self.left_out))
        self._part, self.parts, self.left_out = None, self.parts + 1, Counter()

    def close(self) -> None:
        """Forgets what was not committed."""
        if self._part is not None:
            self._part.abandon()
            self._part = None


def begin(folder: Path, plan: dict[str, Any]) -> None:
    """Writes down what is recorded; arguments and errors as of ``check_place``."""
    if not check_place(folder, plan):
        (folder / "data").mkdir(parents=True, exist_ok=True)
        write_json(folder / "data" / part_files.RECORDING, plan)


def check_place(folder: Path, plan: dict[str, Any]) -> bool:
    """Whether the same recording has begun here, so that the same command goes on with it and no other one does.

    Args:
        folder: The data set's folder.
        plan: Everything that decides what is recorded, ready for JSON.

    Raises:
        BidexError: The folder holds a complete data set, the recording of something else, or something else.
    """
    inner = folder / "data"
    path = inner / part_files.RECORDING
    # With a plan beside it, it was killed between its last two steps, and the index is written once more.
    if is_file(inner / part_files.METADATA) and not is_file(path):
        raise BidexError(f"{folder} holds a complete data set. Name another by --out, or delete it.")
    if is_file(path):
        before = read_json(path, "a recording's plan")
        differ = sorted(name for name in before.keys() | plan.keys() if before.get(name) != plan.get(name))
        if differ:
            name = differ[0]
            raise BidexError(
                f"{folder} is a recording that has not ended, with {name} {before.get(name)}, not {plan.get(name)}. "
                "Give its own command to go on, or name another place by --out."
            )
        return True
    if inner.is_dir():
        remove_leftovers(inner)  # of a recording that was killed as it began
    if folder.exists() and any(folder.iterdir()) and not (inner.is_dir() and not any(inner.iterdir())):
        raise BidexError(f"{folder} exists and is not empty. Name another place by --out.")
    check_writable(path)
    return False


def finish(folder: Path, name: str, observations: Box, actions: Box, metadata: dict[str, Any]) -> None:
    """Completes a data set: writes Minari's index over the parts of all processes, then the metadata.

    Args:
        folder: The data set's folder.
        name: Its name, as Minari takes it: ``CatchUnderarm/random-v0``.
        observations: Space of one observation, (d,).
        actions: Space of one action, (a,).
        metadata: What ``Dataset.metadata`` tells; ``tasks`` must be there. ``left_out`` is added.

    Raises:
        BidexError: Minari would not take the name, or a part is damaged.
    """
    if not valid_name(name):
        raise BidexError(f"Expected a name such as CatchUnderarm/random-v0, got {name!r}. Name another place by --out.")
    inner = folder / "data"
    parts = part_files.parts_of(inner)
    steps = [part_files.read_table(path)["steps"] for path in parts]
    part_files.write_main(inner, parts)
    ours = {"format": part_files.FORMAT, **metadata, "left_out": left_out(inner)}
    size = sum(path.stat().st_size for path in parts)
    content = {
        "total_episodes": sum(map(len, steps)),
        "total_steps": int(sum(each.sum() for each in steps)),
        "data_format": "hdf5",
        "observation_space": _space(observations),
        "action_space": _space(actions),
        "dataset_id": name,
        "minari_version": _MINARI,
        "dataset_size": round(size / 1e6, 1),
        "algorithm_name": str(metadata.get("kind", "")),
        "requirements": [],
        "bidex": ours,
    }
    write_json_compact(inner / part_files.METADATA, content)
    (inner / part_files.RECORDING).unlink(missing_ok=True)


def adopt(inner: Path, folder: Path, name: str) -> None:
    """Makes a complete data set of another one's files: links to them, or copies on another disk.

    Args:
        inner: The folder ``data`` of the other one.
        folder: The new data set's folder.
        name: Its name.

    Raises:
        BidexError: There is something in the folder already, or Minari would not take the name.
    """
    if not valid_name(name):
        raise BidexError(f"Expected a name such as CatchUnderarm/replay-v0, got {name!r}. Name another place by --out.")
    check_place(folder, {})
    new = folder / "data"
    new.mkdir(parents=True, exist_ok=True)
    content = read_json(inner / part_files.METADATA, "a data set's metadata")
    for path in [*part_files.parts_of(inner), inner / part_files.MAIN]:
        try:
            os.link(path, new / path.name)
        except OSError:
            shutil.copyfile(path, new / path.name)
    write_json_compact(new / part_files.METADATA, content | {"dataset_id": name})


def left_out(inner: Path) -> dict[str, int]:
    """What all parts say that was left out, by reason."""
    h5, counts = part_files.hdf5(), Counter()
    for path in part_files.parts_of(inner):
        try:
            with h5.File(path, "r") as file:
                counts.update({name: int(value) for name, value in file.attrs.items()})
        except (OSError, TypeError, ValueError) as error:
            raise part_files.damaged(path, error) from None
    return dict(counts)


def write_json_compact(path: Path, content: Any) -> None:
    """Writes JSON with one entry a line at the top alone: the spaces are long lists."""
    rows = [f"  {json.dumps(name)}: {json.dumps(value)}" for name, value in content.items()]
    text = "{\n" + ",\n".join(rows) + "\n}\n"
    write_atomic(path, lambda file: file.write(text.encode()))


def _space(space: Box) -> str:
    """A space in the words that Minari reads."""
    told = {"type": "Box", "dtype": str(np.dtype(space.dtype)), "shape": list(space.shape)}
    return json.dumps(told | {"low": space.low.tolist(), "high": space.high.tolist()})


def estimated_bytes(steps: int, observation_size: int, action_size: int, episode_steps: float) -> int:
    """Bytes on the disk of so many transitions.

    Args:
        steps: Transitions.
        observation_size: Entries of an observation.
        action_size: Actions.
        episode_steps: Steps of an episode, on average.
    """
    episodes = math.ceil(steps / max(episode_steps, 1.0))
    per_step = 4 * (observation_size + action_size + 1) + 2
    return steps * per_step + episodes * (4 * observation_size + part_files.EPISODE_BYTES)

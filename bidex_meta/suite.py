"""The checked content of a suite file, as frozen dataclasses; `suite_files` reads them from `suites/*.toml`."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Literal

from bidex_meta.errors import BidexError
from bidex_meta.rules import V2, Randomisation, Rules, plain_name
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.files import Json, portable
from bidex_meta.utils.validation import whole_number

Split = Literal["train", "test"]
SPLITS: tuple[Split, Split] = ("train", "test")
OTHERS, OTHER_SEED = "others", 500_000
"""Split name of unseen tasks of the train classes, and the number that is added to a run's seed to draw them."""
DRAWN = 50
"""Number of tasks drawn per class and split if a file says ``tasks_per_class = 0``."""
MOST_POINTS = 16_384
"""Largest number of points of a cloud: more points than a coarse image has pixels show no more detail."""
MOST_TASKS = 1_000_000


@checked_arguments
@dataclass(frozen=True)
class ListedTask:
    """One task that a suite file lists. A class that lists tasks has no randomly drawn tasks."""

    name: str
    """Name that is unique within the class, e.g. `"left"`."""
    split: Split | Literal["both"]
    fixed: Mapping[str, float]
    """Fixed components of the variation by name (metres and radians, world frame); the seed draws the others."""

    def of(self, split: Split) -> bool:
        """Return whether the task belongs to a split."""
        return self.split in (split, "both")


@checked_arguments
@dataclass(frozen=True)
class SuiteClass:
    """One task class of a suite."""

    name: str
    """Name in the suite, e.g. `"CatchUnderarm"` or, with an object, `"CatchUnderarm-block"`."""
    class_name: str
    splits: tuple[Split, ...]
    reward_scale: float
    gamma: float | None
    """Discount per step of this class; None: the learner's own."""
    tasks: tuple[ListedTask, ...]
    """Listed tasks; empty if the tasks are drawn."""
    options: Mapping[str, float | str]
    """Further options of the class, by the names of the class's constructor arguments."""


@checked_arguments
@dataclass(frozen=True)
class Suite:
    """The checked content of a suite file."""

    name: str
    version: int
    """The `-vN` of the Gymnasium id; it goes up when results change."""
    kind: Literal["multi-task", "meta"]
    """Multi-task suites have only a train split. Meta suites have both splits, which share only tasks listed as
    ``both``."""
    description: str
    observation: Literal["plain", "one-hot", "masked"]
    """Change of the padded observation: none (``plain``), task id appended (``one-hot``), goal entries zeroed
    (``masked``)."""
    task_id: Literal["class", "task"]
    """Meaning of one entry of the one-hot: a class or a listed task."""
    rules: Rules
    base: Literal["moving", "alone"]
    """``moving``: the hands' bases move in every class; ``alone``: each class keeps the base that it has outside of
    suites."""
    tasks_per_class: int | None
    """Tasks drawn per class and split; None when every class lists its tasks."""
    classes: tuple[SuiteClass, ...]
    file: Path
    train_tasks: int | None = None
    """Number of tasks drawn per class for the train split; None: ``tasks_per_class``. With 0, training draws a new task
    in each episode or trial, and evaluations on the train split use ``tasks_per_class`` tasks that training never
    draws."""
    points: int = 0
    """Number of points of the cloud that observations show instead of objects' states; 0: they show the states."""
    point_kinds: bool = False
    """True if each point has its kind as a fourth entry."""
    randomisation: Randomisation | None = None
    """Randomisation of training worlds."""
    touch: bool = False
    """True if observations show touch sensors of both hands."""

    def __post_init__(self) -> None:
        """Remove ``-v2`` from the names of classes.

        Raises BidexError if a name ends in ``-v2`` but the suite's rules are not those of version 2.
        """
        object.__setattr__(self, "classes", tuple(_without_version(self, entry) for entry in self.classes))

    @property
    def digest(self) -> str:
        """Return a hash, twelve hexadecimal digits, of everything that decides tasks, rewards and observations.

        The digest ignores the file's version. It also ignores entries that have their default value, so that a new kind
        of entry does not change old digests.
        """
        content = {name: value for name, value in _chosen(self).items() if name not in _OF_THE_FILE}
        if self.rules.wide:
            content["placements"] = "episode"  # before 0.3.0 the tasks fixed the placements
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:12]

    @property
    def splits(self) -> tuple[Split, ...]:
        """Return the splits that hold at least one class."""
        return tuple(split for split in SPLITS if self.split_classes(split))

    def split_classes(self, split: Split) -> tuple[SuiteClass, ...]:
        """Return the classes of one split, in file order."""
        return tuple(entry for entry in self.classes if split in entry.splits)

    def drawn_tasks(self, split: Split) -> int:
        """Return the number of tasks that a split draws for a class that lists no tasks."""
        if split == "train" and self.train_tasks:
            return self.train_tasks
        return self.tasks_per_class or 0

    def task_names(self, split: Split) -> dict[str, list[str]]:
        """Return the names of the tasks in each slot of a split; a drawn task's name is its number.

        A slot is a class, or a listed task if each listed task has its own entry in the task id (one-hot).
        """
        drawn = list(map(str, range(self.drawn_tasks(split))))
        pools = {}
        for entry in self.split_classes(split):
            listed = [task.name for task in entry.tasks if task.of(split)]
            pools[entry.name] = listed or [*drawn]
        if self.task_id == "class":
            return pools
        slots: dict[str, list[str]] = {}
        for name, pool in pools.items():
            slots |= {f"{name}/{task}": [task] for task in pool}
        return slots

    def unseen(self) -> "Suite":
        """Return the suite with unseen tasks as the train tasks of its train classes.

        If a class lists test tasks, these are its unseen tasks. Any other task depends on the seed, apart from the
        components that the file lists.
        """
        train_tasks = self.train_tasks or None
        return replace(self, classes=tuple(map(_unseen, self.classes)), train_tasks=train_tasks)

    def with_train_tasks(self, count: int | None) -> "Suite":
        """Return the suite with ``train_tasks`` replaced; None leaves the suite unchanged.

        Raises BidexError if a class lists its tasks, or the count is not an integer from 0 to a million.
        """
        if count is None:
            return self
        train_tasks = whole_number("tasks_per_class", count, 0, MOST_TASKS)
        check_drawn(self.name, self.classes, train_tasks)
        return replace(self, train_tasks=train_tasks)


_OF_THE_FILE = ("name", "version", "description", "file")


def _chosen(value: object) -> Json:
    """Convert a value to JSON, for the suite's digest.

    A dataclass becomes a dict of the fields that differ from their defaults. An absolute path becomes its file name.
    """
    if is_dataclass(value):
        given = ((entry, getattr(value, entry.name)) for entry in fields(value))
        return {entry.name: _chosen(each) for entry, each in given if each != entry.default and each is not None}
    if isinstance(value, Mapping):
        return {name: _chosen(each) for name, each in value.items()}
    if isinstance(value, tuple):
        return [_chosen(each) for each in value]
    if isinstance(value, Path | str):
        return portable(str(value))
    return value


def _without_version(suite: Suite, entry: SuiteClass) -> SuiteClass:
    plain = plain_name(entry.class_name)
    if plain == entry.class_name:
        return entry
    if suite.rules != V2:
        rules = ", ".join(f'{name} = "{value}"' for name, value in vars(V2).items())
        mend = f'Write name = "{plain}", and for version 2 of the whole suite {rules}.'
        raise error(suite.file, "classes", "names without a version in a suite of other rules", entry.class_name, mend)
    return replace(entry, name=plain_name(entry.name), class_name=plain)


def _unseen(entry: SuiteClass) -> SuiteClass:
    held_out = [replace(task, split="both") for task in entry.tasks if task.split == "test"]
    if held_out and "train" in entry.splits:
        return replace(entry, tasks=tuple(held_out))
    return entry


def check_drawn(name: str, classes: tuple[SuiteClass, ...], count: int) -> None:
    """Raise BidexError if a class lists its tasks: ``count``, a number of tasks to draw, would then have no effect."""
    for entry in classes:
        if entry.tasks:
            raise BidexError(
                f"{name}: tasks_per_class: expected classes whose tasks are drawn, got {count} with the listed tasks "
                f"of {entry.name}. Leave tasks_per_class out, or name a suite without listed tasks."
            )


def error(file: Path, place: str, expected: str, got: object, mend: str = "See suites/README.md.") -> BidexError:
    """Return the error for a faulty entry at ``place`` in a suite file."""
    return BidexError(f"{file}: {place}: expected {expected}, got {got}. {mend}")

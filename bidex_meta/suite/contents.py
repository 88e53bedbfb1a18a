"""Contents of a suite: its classes, listed tasks and randomisation, as frozen dataclasses.

``suites/README.md`` explains them field by field.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from bidex_meta.errors import BidexError
from bidex_meta.suite.rules import V2, Rules, plain_name
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.files import portable
from bidex_meta.utils.validation import check_fields, check_rising

Split = Literal["train", "test"]
SPLITS: tuple[Split, Split] = ("train", "test")
OTHERS, OTHER_SEED = "others", 500_000
"""Name of the tasks of train classes that no run trained on, and what is added to a run's seed to draw them."""
MOST_POINTS = 16_384
"""Of a cloud: more than a coarse image has pixels are no finer."""

_Factor = Annotated[float, Meta(ge=0.01, le=100.0)]
_Size = Annotated[float, Meta(ge=0.8, le=1.25)]
_Steps = Annotated[int, Meta(ge=0, le=60)]
_Range = tuple[_Factor, _Factor]


@dataclass(frozen=True)
class Randomisation:
    """Factors drawn for an environment, uniformly from ranges, and added noise; nothing by default.

    Raises BidexError for values out of bounds or ranges that fall.
    """

    friction: _Range = (1.0, 1.0)
    """Factor of the friction of all contacts."""
    object_mass: _Range = (1.0, 1.0)
    object_size: tuple[_Size, _Size] = (1.0, 1.0)
    """Factor of the lengths of free objects without joints; their masses stay."""
    actuator_gain: _Range = (1.0, 1.0)
    """Factor of the fingers' actuator forces, before their limits."""
    joint_damping: _Range = (1.0, 1.0)
    """Factor of the damping of the fingers' joints."""
    gravity: _Range = (1.0, 1.0)
    observation_noise: Annotated[float, Meta(ge=0.0, le=5.0)] = 0.0
    """Standard deviation in an observation's units, of what sensors show of hands and objects."""
    action_noise: Annotated[float, Meta(ge=0.0, le=2.0)] = 0.0
    """Standard deviation; actions are clipped afterwards."""
    action_delay: tuple[_Steps, _Steps] = (0, 0)
    """Control steps, a whole number of the range."""
    push_speed: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.0
    """Most that a push adds to the velocity of all objects along each axis, m/s."""
    push_interval: Annotated[float, Meta(ge=0.1, le=1000.0)] = 1.0
    """Mean time between pushes, s."""
    draw: Literal["episode", "environment"] = "episode"
    """Whether factors and the delay are drawn for every episode, or once for an environment."""

    def __post_init__(self) -> None:
        check_fields(self, "randomisation")
        check_rising(self, "randomisation", *FACTORS, "action_delay")


FACTORS = ("friction", "object_mass", "object_size", "actuator_gain", "joint_damping", "gravity")
"""Of a randomisation, those that are factors of the model's numbers."""


@checked_arguments
@dataclass(frozen=True)
class ListedTask:
    """One task that a suite file writes out, in place of drawing it."""

    name: str
    """Unique within its class, e.g. `"left"`."""
    split: Split | Literal["both"]
    fixed: Mapping[str, float]
    """Given components of the variation (metres and radians, world frame); the others are drawn by the seed."""

    def of(self, split: Split) -> bool:
        """Return whether the task is one of a split."""
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
    """Listed tasks; empty where the tasks are drawn."""
    options: Mapping[str, float | str]
    """Further options of the class, by the names of its constructor's arguments."""


@checked_arguments
@dataclass(frozen=True)
class Suite:
    """A suite file, checked."""

    name: str
    version: int
    """The `-vN` of the Gymnasium id; goes up when results change."""
    kind: Literal["multi-task", "meta"]
    """Multi-task suites have a train split only; meta suites both, without a task in common."""
    description: str
    observation: Literal["plain", "one-hot", "masked"]
    """Change of the padded observation: none, task id appended, goal entries zeroed."""
    task_id: Literal["class", "task"]
    """Meaning of one entry of the one-hot: a class or a listed task."""
    rules: Rules
    base: Literal["moving", "alone"]
    """Moving bases for every class, or for each class the base that it has alone."""
    tasks_per_class: int | None
    """Tasks drawn per class and split; None when every class lists its tasks."""
    classes: tuple[SuiteClass, ...]
    file: Path
    points: int = 0
    """Points of the cloud that observations show in the place of objects' states; 0: they show the states."""
    point_kinds: bool = False
    """True if each point has its kind as a fourth entry."""
    randomisation: Randomisation | None = None
    """Randomisation of training worlds."""

    def __post_init__(self) -> None:
        """Name classes without a version; raise BidexError for ``CatchUnderarm-v2`` in a suite of other rules."""
        object.__setattr__(self, "classes", tuple(_without_version(self, entry) for entry in self.classes))

    @property
    def digest(self) -> str:
        """Return twelve hexadecimal digits of everything that decides tasks, rewards and observations.

        The file's version does not enter. Entries with their default value do not enter either, so that a new kind of
        entry leaves old digests as they are.
        """
        content = {name: value for name, value in _chosen(self).items() if name not in _OF_THE_FILE}
        if self.rules.wide:
            content["placements"] = "episode"  # before version 0.3.0 a task fixed them
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:12]

    @property
    def splits(self) -> tuple[Split, ...]:
        """Return the splits that hold at least one class."""
        return tuple(split for split in SPLITS if self.split_classes(split))

    def split_classes(self, split: Split) -> tuple[SuiteClass, ...]:
        """Return the classes of one split, in file order."""
        return tuple(entry for entry in self.classes if split in entry.splits)


_OF_THE_FILE = ("name", "version", "description", "file")


def _chosen(value: Any) -> Any:
    """Return a value ready for JSON: the fields of dataclasses that differ from their default, paths as names."""
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
        raise file_error(
            suite.file, "classes", "names without a version in a suite of other rules", entry.class_name, mend
        )
    return replace(entry, name=plain_name(entry.name), class_name=plain)


def file_error(file: Path, place: str, expected: str, got: object, mend: str = "See suites/README.md.") -> BidexError:
    """Return an error for a place of a suite file."""
    return BidexError(f"{file}: {place}: expected {expected}, got {got}. {mend}")

"""Reads and checks `suites/*.toml` into frozen dataclasses; `suites/README.md` explains the files field by field.

Names of task classes and of the components of their variations are checked where the classes are known, in
`bidex_meta.benchmark`.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

from bidex_meta.errors import BidexError, known_name, shortened, unknown_name
from bidex_meta.outside import name_with_object
from bidex_meta.paths import suites_dir
from bidex_meta.reading import absolute, expanded, read_toml

Split = Literal["train", "test"]
SPLITS: tuple[Split, Split] = ("train", "test")
_LARGEST = 1_000_000
"""Of any number in a suite file: metres, radians, tasks; beyond it nothing is meant."""
MOST_POINTS = 16_384
"""Of a cloud: more than a coarse image has pixels are no finer."""
_LONGEST_TEXT, _MOST_TABLES = 500, 1000


_V = TypeVar("_V")


class ReadOnly(Mapping[str, _V]):
    """A mapping that nobody changes and, unlike Python's own ``MappingProxyType``, everybody may pickle.

    Args:
        content: Is copied.
    """

    def __init__(self, content: Mapping[str, _V]) -> None:
        self._content = dict(content)

    def __getitem__(self, key: str) -> _V:
        return self._content[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._content)

    def __len__(self) -> int:
        return len(self._content)

    def __repr__(self) -> str:
        """As the dict of its content."""
        return repr(self._content)


@dataclass(frozen=True)
class ListedTask:
    """One task that a suite file writes out, in place of drawing it."""

    name: str
    """Unique within its class, e.g. `"left"`."""
    split: Split
    """The split it belongs to."""
    fixed: Mapping[str, float]
    """Given components of the variation (metres and radians, world frame); the others are drawn by the seed."""


@dataclass(frozen=True)
class SuiteClass:
    """One task class of a suite."""

    name: str
    """What it is called in the suite, e.g. `"CatchUnderarm"` or, with an object, `"CatchUnderarm-block"`."""
    class_name: str
    """The task class, e.g. `"CatchUnderarm"`."""
    splits: tuple[Split, ...]
    """Where it appears: train, test or both."""
    reward_scale: float
    """Factor on the reward the learner sees."""
    gamma: float | None
    """Discount per step of this class; None: the learner's own."""
    tasks: tuple[ListedTask, ...]
    """Listed tasks; empty where the tasks are drawn."""
    options: Mapping[str, float | str]
    """What else the class lets one choose, by the names of its constructor's arguments."""


@dataclass(frozen=True)
class Suite:
    """What a suite file says, checked."""

    name: str
    """E.g. `"MT4"`."""
    version: int
    """The `-vN` of the Gymnasium id; goes up when results change."""
    kind: Literal["multi-task", "meta"]
    """Multi-task suites have a train split only; meta suites both, without a task in common."""
    description: str
    """One line for lists."""
    observation: Literal["plain", "one-hot", "masked"]
    """What is done to the padded observation: nothing, task id appended, goal entries zeroed."""
    task_id: Literal["class", "task"]
    """What one entry of the one-hot stands for: a class or a listed task."""
    reward: Literal["paper"]
    """Which reward formulas."""
    base: Literal["moving", "alone"]
    """Whether every class gets the moving base, or each what it has on its own."""
    tasks_per_class: int | None
    """Tasks drawn per class and split; None when every class lists its tasks."""
    classes: tuple[SuiteClass, ...]
    """In the order of rows, one-hot and task lists."""
    file: Path
    """Where it was read from."""
    points: int = 0
    """Points of the cloud that observations show in the place of objects' states; 0: they show the states."""
    point_kinds: bool = False
    """Whether each point tells what it is of."""

    @property
    def splits(self) -> tuple[Split, ...]:
        """The splits that hold at least one class."""
        return tuple(split for split in SPLITS if self.split_classes(split))

    def split_classes(self, split: Split) -> tuple[SuiteClass, ...]:
        """The classes of one split, in file order."""
        return tuple(entry for entry in self.classes if split in entry.splits)


def suite_names() -> list[str]:
    """Names of the suites that this installation ships, sorted."""
    return sorted(path.stem for path in suites_dir().glob("*.toml"))


def load_suite(name_or_path: str | Path) -> Suite:
    """Reads a shipped suite by name, or any suite file by path.

    Args:
        name_or_path: E.g. `"MT4"`, in any case, or the path of a `.toml` file: a `Path`, or a text that ends so.

    Raises:
        BidexError: No such suite or file, or the file does not say what `suites/README.md` asks for.
    """
    text = str(name_or_path)
    if isinstance(name_or_path, Path) or text.endswith(".toml"):
        return _parse(expanded(name_or_path))
    return _parse(suites_dir() / f"{known_name('suite', text, suite_names())}.toml")


def _parse(file: Path) -> Suite:
    content = read_toml(file, "a suite file")
    table = _Table(file, "", content)
    points, kinds = _parse_points(table.table("points", "{ count = 768 }")) if "points" in content else (0, False)
    suite = Suite(
        name=table.text("name"),
        version=table.count("version"),
        kind=table.choice("kind", "multi-task", "meta"),
        description=table.text("description"),
        observation=table.choice("observation", "plain", "one-hot", "masked"),
        task_id=table.choice("task_id", "class", "task"),
        reward=table.choice("reward", "paper"),
        base=table.choice("base", "moving", "alone"),
        tasks_per_class=table.count("tasks_per_class") if "tasks_per_class" in content else None,
        classes=tuple(entry for each in table.tables("classes") for entry in _parse_classes(each)),
        file=file,
        points=points,
        point_kinds=kinds,
    )
    table.finish()
    _check(suite, table)
    return suite


def _parse_points(table: "_Table") -> tuple[int, bool]:
    count, kinds = table.count("count") if "count" in table.content else 768, table.flag("kinds", default=False)
    table.finish()
    if count > MOST_POINTS:
        raise table.error("count", f"a whole number of at most {MOST_POINTS:,}", count)
    return count, kinds


def _parse_classes(table: "_Table") -> list[SuiteClass]:
    """A class, or with `objects` one for each of them."""
    entry = _parse_class(table)
    objects = table.things("objects") if "objects" in table.content else []
    table.finish()
    given = entry.options.get("object")
    if objects and given is not None:
        raise table.error("objects", "either objects or options.object", "both", "Leave one of them out.")
    if not objects:
        return [replace(entry, name=name_with_object(entry.class_name, cast(str | None, given)))]
    return [
        replace(
            entry,
            name=name_with_object(entry.class_name, thing),
            options=ReadOnly({**entry.options, "object": thing}),
        )
        for thing in objects
    ]


def _parse_class(table: "_Table") -> SuiteClass:
    split = table.choice("split", "train", "test", "both", default="train")
    name = table.text("name")
    entry = SuiteClass(
        name=name,
        class_name=name,
        splits=SPLITS if split == "both" else (cast(Split, split),),
        reward_scale=table.number("reward_scale", default=1.0),
        gamma=table.number("gamma") if "gamma" in table.content else None,
        tasks=tuple(_parse_task(task) for task in table.tables("tasks", default=())),
        options=ReadOnly(_parse_options(table) if "options" in table.content else {}),
    )
    if entry.reward_scale <= 0.0:
        raise table.error("reward_scale", "a number above 0", entry.reward_scale)
    if entry.gamma is not None and not 0.0 <= entry.gamma < 1.0:
        raise table.error("gamma", "a number from 0 to below 1", entry.gamma)
    return entry


def _parse_options(table: "_Table") -> dict[str, float | str]:
    options = table.table("options")

    def parsed(key: str) -> float | str:
        if key == "object":
            return options.thing(key)
        # A whole number stays one: it may count something.
        return options.number(key) if isinstance(options.content[key], float) else options.count(key)

    return {key: parsed(key) for key in options.content}


def _parse_task(table: "_Table") -> ListedTask:
    fixed = table.table("fixed")
    task = ListedTask(
        name=table.text("name"),
        split=table.choice("split", *SPLITS, default="train"),
        fixed=ReadOnly({key: fixed.number(key) for key in fixed.content}),
    )
    table.finish()
    return task


def _check(suite: Suite, table: "_Table") -> None:
    _check_unique(table, "classes", [entry.name for entry in suite.classes])
    expected = SPLITS if suite.kind == "meta" else ("train",)
    if suite.splits != expected:
        mend = "Give each class a split." if suite.kind == "meta" else 'Leave split out, or write kind = "meta".'
        received = ", ".join(suite.splits)
        raise table.error("classes", f"a {suite.kind} suite with the splits {', '.join(expected)}", received, mend)
    all_listed = all(entry.tasks for entry in suite.classes)
    if all_listed and suite.tasks_per_class is not None:
        mend = "Leave it out: every class lists its tasks."
        raise table.error("tasks_per_class", "nothing", suite.tasks_per_class, mend)
    if not all_listed and suite.tasks_per_class is None:
        raise table.error("tasks_per_class", "a whole number from 1 on", "nothing", "Add it, or list every task.")
    if suite.task_id == "task" and not all_listed:
        raise table.error("task_id", '"class", since not every class lists its tasks', suite.task_id)
    for index, entry in enumerate(suite.classes):
        if entry.tasks:
            _check_listed(entry, _Table(table.file, f"classes[{index}].", {}))


def _check_listed(entry: SuiteClass, table: "_Table") -> None:
    _check_unique(table, "tasks", [task.name for task in entry.tasks])
    listed = tuple(split for split in SPLITS if any(task.split == split for task in entry.tasks))
    if listed != entry.splits:
        mend = f"Make split of {entry.name} and of its tasks agree."
        raise table.error("tasks", f"tasks in {' and '.join(entry.splits)}", f"in {' and '.join(listed)}", mend)
    train, test = ([task for task in entry.tasks if task.split == split] for split in SPLITS)
    for held_out in test:
        for other in train:
            if held_out.fixed == other.fixed:
                received = f"{other.name!r} and {held_out.name!r} with the same fixed values"
                raise table.error("tasks", "train and test tasks that differ", received, "Change one of them.")


def _check_unique(table: "_Table", key: str, names: list[str]) -> None:
    for name, times in Counter(names).items():
        if times > 1:
            raise table.error(f"{key}.name", "each name once", f"{name!r} {times} times", "Remove one.")


_REQUIRED: Any = object()


class _Table:
    """A TOML table that is asked for each of its keys by type, and at the end for keys nobody asked for."""

    def __init__(self, file: Path, prefix: str, content: dict[str, Any]) -> None:
        self.file = file
        self.content = content
        self._prefix = prefix
        self._asked: list[str] = []

    def text(self, key: str) -> str:
        value = self._get(key, "a text in quotes", _REQUIRED)
        if not isinstance(value, str) or not value.strip():
            raise self.error(key, "a text in quotes", value)
        # Names and descriptions come to terminals, which obey what is not printable.
        if not value.isprintable() or len(value) > _LONGEST_TEXT:
            raise self.error(key, f"printable text of at most {_LONGEST_TEXT} letters", value)
        return value

    def thing(self, key: str) -> str:
        """An object's name; of a file its path, which is relative to the suite file's folder."""
        return self._placed(self.text(key))

    def things(self, key: str) -> list[str]:
        values = self._get(key, "a list of objects", _REQUIRED)
        fits = isinstance(values, list) and 0 < len(values) <= _MOST_TABLES
        if not fits or not all(isinstance(value, str) and value.strip() and value.isprintable() for value in values):
            raise self.error(key, 'a list of objects such as ["egg", "block"]', values)
        return [self._placed(value) for value in values]

    def _placed(self, value: str) -> str:
        return str(absolute(self.file.parent / expanded(value))) if value.endswith(".xml") else value

    def choice(self, key: str, *choices: str, default: str = _REQUIRED) -> Any:
        expected = " or ".join(f'"{choice}"' for choice in choices)
        value = self._get(key, expected, default)
        if not isinstance(value, str) or value not in choices:
            raise self.error(key, expected, value)
        return value

    def count(self, key: str) -> int:
        value = self._get(key, "a whole number from 1 on", _REQUIRED)
        if type(value) is not int or value < 1:
            raise self.error(key, "a whole number from 1 on", value)
        if value > _LARGEST:
            raise self.error(key, f"a whole number of at most {_LARGEST:,}", value)
        return value

    def flag(self, key: str, default: bool) -> bool:
        value = self._get(key, "true or false", default)
        if not isinstance(value, bool):
            raise self.error(key, "true or false", value)
        return value

    def number(self, key: str, default: float = _REQUIRED) -> float:
        value = self._get(key, "a number", default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise self.error(key, "a finite number", value)
        if abs(value) > _LARGEST:
            raise self.error(key, f"a number within +-{_LARGEST:,}", value)
        return float(value)

    def table(self, key: str, example: str = "{ goal_x = 0.0 }") -> "_Table":
        value = self._get(key, "a table", _REQUIRED)
        if not isinstance(value, dict):
            raise self.error(key, f"a table such as {example}", value)
        return _Table(self.file, f"{self._prefix}{key}.", value)

    def tables(self, key: str, default: Any = _REQUIRED) -> list["_Table"]:
        expected = f"at least one [[{key}]] table"
        value = self._get(key, expected, default)
        if value is default:
            return []
        if not isinstance(value, list) or not value or not all(isinstance(entry, dict) for entry in value):
            raise self.error(key, expected, value)
        if len(value) > _MOST_TABLES:
            raise self.error(key, f"at most {_MOST_TABLES:,} tables", f"{len(value):,}", "Leave some out.")
        return [_Table(self.file, f"{self._prefix}{key}[{index}].", entry) for index, entry in enumerate(value)]

    def finish(self) -> None:
        for key in self.content:
            if key not in self._asked:
                where = f"{self.file}: {self._prefix}{key}"
                raise BidexError(f"{where}: {unknown_name('key', key, self._asked)}")

    def error(self, key: str, expected: str, received: object, mend: str = "") -> BidexError:
        shown = received if isinstance(received, str) and mend else shortened(received)
        hint = mend or "See suites/README.md."
        return BidexError(f"{self.file}: {self._prefix}{key}: expected {expected}, got {shown}. {hint}")

    def _get(self, key: str, expected: str, default: Any) -> Any:
        self._asked.append(key)
        if key not in self.content and default is _REQUIRED:
            near = [given for given in self.content if given not in self._asked]
            raise self.error(key, expected, "nothing", f"Add {key} (keys given: {', '.join(near) or 'none'}).")
        return self.content.get(key, default)

"""Reads and checks ``suites/*.toml`` into the dataclasses of ``bidex_meta.suite.contents``.

Names of task classes and of their variations are checked where the classes are known, in ``bidex_meta.benchmark``.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from functools import cache
from itertools import product
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from bidex_meta.errors import BidexError, known_name, nearest, shortened, unknown_name
from bidex_meta.suite import ladder
from bidex_meta.suite.contents import (
    MOST_POINTS,
    SPLITS,
    ListedTask,
    Randomisation,
    Split,
    Suite,
    SuiteClass,
    file_error,
)
from bidex_meta.suite.rules import Rules
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.files import absolute, expanded, read_toml
from bidex_meta.utils.paths import suites_dir
from bidex_meta.utils.plugins import name_with_object
from bidex_meta.utils.validation import parse

METAWORLD_SUITES: dict[str, tuple[str, ...]] = {
    "metaworld/MT10": (
        "reach-v3", "push-v3", "pick-place-v3", "door-open-v3", "drawer-open-v3", "drawer-close-v3",
        "button-press-topdown-v3", "peg-insert-side-v3", "window-open-v3", "window-close-v3",
    ),
    # No suite of Meta-World's: three of its classes that are learned within minutes.
    "metaworld/MT3": ("reach-v3", "drawer-close-v3", "button-press-topdown-v3"),
}  # fmt: skip
"""Suites of Meta-World's own environments, and their classes in its order."""


def suite_names() -> list[str]:
    """Return the names of the suites that this installation ships: sorted, then those of a single class."""
    classes = [entry.name for entry in _shipped("MT20-v2").classes]
    return [*file_names(), *ladder.names_of(classes)]


def file_names() -> list[str]:
    """Return the names of the shipped suites that have a file of their own, sorted."""
    return sorted(path.stem for path in suites_dir().glob("*.toml"))


@checked_arguments
def metaworld_classes(suite: str) -> tuple[str, ...]:
    """Return the classes of one of Meta-World's suites; raises BidexError for another, with the nearest name."""
    if suite not in METAWORLD_SUITES:
        raise unknown_name("suite of Meta-World", suite, METAWORLD_SUITES)
    return METAWORLD_SUITES[suite]


@checked_arguments
def load_suite(name_or_path: str | Path) -> Suite:
    """Read a shipped suite by name, in any case, or a suite file by path: a `Path`, or a text ending in `.toml`.

    Raises BidexError for a missing suite or file, or a file that is not as `suites/README.md` describes.
    """
    text = str(name_or_path)
    if isinstance(name_or_path, Path) or text.endswith(".toml"):
        return _parse(expanded(name_or_path))
    names = suite_names()
    if text.casefold() not in {name.casefold() for name in names}:
        meant = {text.casefold(): nearest(text, names) or "MT4"}
        raise unknown_name("suite", text, [*file_names(), *ladder.names_of(["CLASS"])], meant)
    name = known_name("suite", text, names)
    template = ladder.template_of(name)
    if template is None:
        return _shipped(name)
    return ladder.suite_of(name, _shipped(template))


@cache
def _shipped(name: str) -> Suite:
    """Return the suite of a file."""
    return _parse(suites_dir() / f"{name}.toml")


@checked_arguments
def load_randomisation(path: str | Path) -> Randomisation:
    """Read the table ``[randomisation]`` of a TOML file: a suite's, or a file that holds nothing else.

    Raises BidexError if the file has no such table, or a faulty one.
    """
    content = read_toml(expanded(path), "a file with a table [randomisation]")
    if "randomisation" not in content:
        raise BidexError(f"{path}: expected a table [randomisation], found none. See docs/randomisation.md.")
    return parse(content["randomisation"], Randomisation, f"{path}: randomisation", exact=True)


# What stands in a file, as msgspec checks it. No number is larger than a million: beyond it nothing is meant.
_Text = Annotated[str, Meta(min_length=1, max_length=500)]
_Count = Annotated[int, Meta(ge=1, le=1_000_000)]
_Number = Annotated[float, Meta(ge=-1_000_000, le=1_000_000)]
_Tables = Meta(min_length=1, max_length=1000)


@dataclass
class _TaskEntry:
    name: _Text
    fixed: dict[str, _Number]
    split: Split | Literal["both"] = "train"


@dataclass
class _ClassEntry:
    name: _Text
    split: Literal["train", "test", "both"] = "train"
    reward_scale: Annotated[float, Meta(gt=0.0, le=1_000_000)] = 1.0
    gamma: Annotated[float, Meta(ge=0.0, lt=1.0)] | None = None
    tasks: Annotated[list[_TaskEntry], _Tables] = field(default_factory=list)
    options: dict[str, _Count | _Number | _Text] = field(default_factory=dict)  # a whole number may count something
    objects: Annotated[list[_Text], _Tables] = field(default_factory=list)


@dataclass
class _PointsEntry:
    count: Annotated[int, Meta(ge=1, le=MOST_POINTS)] = 768
    kinds: bool = False


@dataclass
class _File:
    name: _Text
    version: _Count
    kind: Literal["multi-task", "meta"]
    description: _Text
    observation: Literal["plain", "one-hot", "masked"]
    task_id: Literal["class", "task"]
    reward: Literal["paper", "v2"]
    base: Literal["moving", "alone"]
    classes: Annotated[list[_ClassEntry], _Tables]
    tasks_per_class: _Count | None = None
    points: _PointsEntry | None = None
    randomisation: Randomisation | None = None
    variation: Literal["narrow", "wide"] = "narrow"
    success: Literal["once", "at-end"] = "once"
    starts: Literal["plain", "jittered"] = "plain"

    def texts(self) -> Iterator[tuple[str, object]]:
        """Yield every text that may be printed on a terminal, with its location in the file."""
        yield from (("name", self.name), ("description", self.description))
        for i, entry in enumerate(self.classes):
            yield f"classes[{i}].name", entry.name
            yield from ((f"classes[{i}].tasks[{j}].name", task.name) for j, task in enumerate(entry.tasks))
            yield from ((f"classes[{i}].objects", name) for name in entry.objects)
            yield from ((f"classes[{i}].options.object", name) for name in [entry.options.get("object", "egg")])


def _parse(file: Path) -> Suite:
    content = parse(read_toml(file, "a suite file"), _File, str(file), exact=True)
    for place, text in content.texts():
        # Terminals obey what is not printable.
        if not isinstance(text, str) or not text.strip() or not text.isprintable():
            raise file_error(file, place, "printable text", shortened(text))
    points = content.points or _PointsEntry(0)
    rules = Rules(content.reward, content.variation, content.success, content.starts)
    given = {f.name: getattr(content, f.name) for f in fields(content) if f.name in {f.name for f in fields(Suite)}}
    classes = tuple(each for i, entry in enumerate(content.classes) for each in _classes(file, i, entry))
    given |= {"classes": classes, "file": file, "rules": rules}
    suite = Suite(**given | {"points": points.count, "point_kinds": points.kinds})
    _check(suite)
    return suite


def _classes(file: Path, index: int, entry: _ClassEntry) -> Iterator[SuiteClass]:
    """Yield the class of an entry, or with `objects` one class per object."""
    options: dict[str, float | str] = dict(entry.options)
    for name, value in options.items():
        if isinstance(value, str) != (name == "object"):
            raise file_error(file, f"classes[{index}].options.{name}", "a number", shortened(value))
    given = options.pop("object", None)
    if entry.objects and given is not None:
        mend = "Leave one of them out."
        raise file_error(file, f"classes[{index}].objects", "either objects or options.object", "both", mend)
    for name in entry.objects or [given]:
        if name is None:
            object = None
        else:
            object = _object(file, str(name))
        yield SuiteClass(
            name=name_with_object(entry.name, object),
            class_name=entry.name,
            splits=SPLITS if entry.split == "both" else (entry.split,),
            reward_scale=entry.reward_scale,
            gamma=entry.gamma,
            tasks=tuple(ListedTask(task.name, task.split, task.fixed) for task in entry.tasks),
            options=options if object is None else {**options, "object": object},
        )


def _object(file: Path, name: str) -> str:
    """Return an object's name; for a file its path, which is relative to the suite file's folder."""
    if name.endswith(".xml"):
        return str(absolute(file.parent / expanded(name)))
    return name


def _check(suite: Suite) -> None:
    _check_unique(suite.file, "classes", [entry.name for entry in suite.classes])
    if suite.kind == "meta":
        expected = SPLITS
    else:
        expected = ("train",)
    if suite.splits != expected:
        if suite.kind == "meta":
            mend = "Give each class a split."
        else:
            mend = 'Leave split out, or write kind = "meta".'
        wanted = f"a {suite.kind} suite with the splits {', '.join(expected)}"
        raise file_error(suite.file, "classes", wanted, ", ".join(suite.splits), mend)
    all_listed = all(entry.tasks for entry in suite.classes)
    if all_listed and suite.tasks_per_class is not None:
        mend = "Leave it out: every class lists its tasks."
        raise file_error(suite.file, "tasks_per_class", "nothing", suite.tasks_per_class, mend)
    if not all_listed and suite.tasks_per_class is None:
        mend = "Add it, or list every task."
        raise file_error(suite.file, "tasks_per_class", "a whole number from 1 on", "nothing", mend)
    if suite.task_id == "task" and not all_listed:
        raise file_error(suite.file, "task_id", '"class", since not every class lists its tasks', suite.task_id)
    for index, entry in enumerate(suite.classes):
        if entry.tasks:
            _check_listed(suite.file, f"classes[{index}].tasks", entry)


def _check_listed(file: Path, place: str, entry: SuiteClass) -> None:
    _check_unique(file, place, [task.name for task in entry.tasks])
    splits = tuple(split for split in SPLITS if any(task.of(split) for task in entry.tasks))
    if splits != entry.splits:
        mend = f"Make split of {entry.name} and of its tasks agree."
        raise file_error(file, place, f"tasks in {' and '.join(entry.splits)}", f"in {' and '.join(splits)}", mend)
    train, test = ([task for task in entry.tasks if task.split == split] for split in SPLITS)
    for held_out, other in product(test, train):
        if held_out.fixed == other.fixed:
            got = f"{other.name!r} and {held_out.name!r} with the same fixed values"
            raise file_error(file, place, "train and test tasks that differ", got, "Change one of them.")


def _check_unique(file: Path, place: str, names: list[str]) -> None:
    for name, times in Counter(names).items():
        if times > 1:
            raise file_error(file, f"{place}.name", "each name once", f"{name!r} {times} times", "Remove one.")

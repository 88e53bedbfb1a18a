"""Finds suites by name, and reads and checks `suites/*.toml`; `suites/README.md` explains the files field by field.

The names of task classes and of their variations are checked in `bidex_meta.benchmark`, which knows the classes.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, fields, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from bidex_meta import ladder
from bidex_meta.errors import BidexError, nearest, shortened, unknown_name
from bidex_meta.rules import Randomisation, Rules
from bidex_meta.suite import (
    DRAWN,
    MOST_POINTS,
    MOST_TASKS,
    SPLITS,
    ListedTask,
    Split,
    Suite,
    SuiteClass,
    check_drawn,
    error,
)
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
    # Meta-World does not have this suite. Its three classes can be learned within minutes.
    "metaworld/MT3": ("reach-v3", "drawer-close-v3", "button-press-topdown-v3"),
}  # fmt: skip
"""Suites of Meta-World's own environments, with their classes in Meta-World's order."""


def suite_names() -> list[str]:
    """Return the names of all shipped suites: first those with a file, sorted, then the others."""
    classes = [entry.name for entry in _shipped("MT20-v2").classes]
    return [*file_names(), *ladder.names_of(classes)]


def file_names() -> list[str]:
    """Return the names of the shipped suites that have a file of their own, sorted."""
    return sorted(path.stem for path in suites_dir().glob("*.toml"))


@checked_arguments
def metaworld_classes(suite: str) -> tuple[str, ...]:
    """Return the classes of one of Meta-World's suites.

    Raises BidexError, which suggests the nearest name, if there is no such suite.
    """
    if suite not in METAWORLD_SUITES:
        raise unknown_name("suite of Meta-World", suite, METAWORLD_SUITES)
    return METAWORLD_SUITES[suite]


@checked_arguments
def load_suite(name_or_path: str | Path) -> Suite:
    """Read a shipped suite by name, ignoring case, or a suite file by path: a `Path`, or a text ending in `.toml`.

    Raises BidexError for a missing suite or file, or for a file that does not follow `suites/README.md`.
    """
    text = str(name_or_path)
    if isinstance(name_or_path, Path) or text.endswith(".toml"):
        return _parse(expanded(name_or_path))
    name = known_suite(text)
    parts = ladder.parts_of(name)
    if parts is None:
        return _shipped(name)
    return _from_template(name, parts)


def known_suite(name: str, more: Iterable[str] = (), kind: str = "suite") -> str:
    """Return the name of a suite, or the entry of ``more``, that equals ``name``, ignoring case.

    Raises BidexError if there is none. The message has the nearest name and a list in which ``CLASS`` stands for every
    class, so that the suites of a single class are not all listed.
    """
    names = [*suite_names(), *more]
    folded = {known.casefold(): known for known in names}
    if name.casefold() not in folded:
        near = nearest(name, names)
        listed = [*file_names(), *ladder.names_of([ladder.ANY_CLASS]), *more]
        raise unknown_name(kind, name, listed, {name.casefold(): near} if near else {})
    return folded[name.casefold()]


@cache
def _shipped(name: str) -> Suite:
    """Return the suite of a shipped file, by name."""
    return _parse(suites_dir() / f"{name}.toml")


def _from_template(name: str, parts: ladder.Parts) -> Suite:
    template = _shipped(parts.template)
    splits = ("train",) if parts.shows_goals else SPLITS
    classes = []
    for of in parts.classes:
        tasks = tuple(ListedTask(*task) for task in parts.tasks(of))
        classes.append(replace(template.classes[0], name=of, class_name=of, splits=splits, tasks=tasks))
    suite = replace(template, name=name, description=parts.description, classes=tuple(classes))
    if classes[0].tasks:
        return replace(suite, tasks_per_class=None)
    return suite


@checked_arguments
def load_randomisation(path: str | Path) -> Randomisation:
    """Read the table ``[randomisation]`` of a TOML file: a suite file, or a file that has only this table.

    Raises BidexError if the file has no such table, or a faulty one.
    """
    content = read_toml(expanded(path), "a file with a table [randomisation]")
    if "randomisation" not in content:
        raise BidexError(f"{path}: expected a table [randomisation], found none. See docs/randomisation.md.")
    return parse(content["randomisation"], Randomisation, f"{path}: randomisation", exact=True)


# These types describe the contents of a suite file for msgspec. No sensible value is larger than a million.
_Text = Annotated[str, Meta(min_length=1, max_length=500)]
_Count = Annotated[int, Meta(ge=1, le=MOST_TASKS)]
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
    # An option that counts something must be a whole number.
    options: dict[str, _Count | _Number | _Text] = field(default_factory=dict)
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
    tasks_per_class: Annotated[int, Meta(ge=0, le=MOST_TASKS)] | None = None
    points: _PointsEntry | None = None
    touch: bool = False
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
            yield f"classes[{i}].options.object", entry.options.get("object", "egg")


def _parse(file: Path) -> Suite:
    content = parse(read_toml(file, "a suite file"), _File, str(file), exact=True)
    for place, text in content.texts():
        # Control characters would change the terminal, so only printable characters are allowed.
        if not isinstance(text, str) or not text.strip() or not text.isprintable():
            raise error(file, place, "printable text", shortened(text))
    points = content.points or _PointsEntry(0)
    rules = Rules(content.reward, content.variation, content.success, content.starts)
    names = {entry.name for entry in fields(Suite)} & {entry.name for entry in fields(content)}
    given = {name: getattr(content, name) for name in names}
    classes: list[SuiteClass] = []
    for i, entry in enumerate(content.classes):
        classes += _classes(file, i, entry)
    given |= {"classes": tuple(classes), "file": file, "rules": rules}
    if content.tasks_per_class == 0:
        given |= {"tasks_per_class": DRAWN, "train_tasks": 0}
    suite = Suite(**given | {"points": points.count, "point_kinds": points.kinds})
    _check(suite)
    return suite


def _classes(file: Path, index: int, entry: _ClassEntry) -> Iterator[SuiteClass]:
    """Yield the task classes that one entry of a suite file stands for.

    An entry stands for one class, or, if it has ``objects``, for one class per object.
    """
    options: dict[str, float | str] = dict(entry.options)
    for name, value in options.items():
        if isinstance(value, str) != (name == "object"):
            raise error(file, f"classes[{index}].options.{name}", "a number", shortened(value))
    given = options.pop("object", None)
    if entry.objects and given is not None:
        mend = "Leave one of them out."
        raise error(file, f"classes[{index}].objects", "either objects or options.object", "both", mend)
    if entry.split == "both":
        splits = SPLITS
    else:
        splits = (entry.split,)
    for name in entry.objects or [given]:
        if name is None:
            chosen = None
        else:
            chosen = options["object"] = _object(file, str(name))
        yield SuiteClass(
            name=name_with_object(entry.name, chosen),
            class_name=entry.name,
            splits=splits,
            reward_scale=entry.reward_scale,
            gamma=entry.gamma,
            tasks=tuple(ListedTask(task.name, task.split, task.fixed) for task in entry.tasks),
            options=dict(options),
        )


def _object(file: Path, name: str) -> str:
    """Return the absolute path of an object's MJCF file; return the name of a shipped object unchanged.

    Relative paths start at the suite file's folder.
    """
    if name.endswith(".xml"):
        return str(absolute(file.parent / expanded(name)))
    return name


def _names(suite: Suite, split: Split) -> tuple[str, ...]:
    return tuple(entry.name for entry in suite.split_classes(split))


def _check(suite: Suite) -> None:
    _check_unique(suite.file, "classes", [entry.name for entry in suite.classes])
    if suite.kind == "meta":
        expected = SPLITS
        mend = "Give each class a split."
    else:
        expected = ("train",)
        mend = 'Leave split out, or write kind = "meta".'
    if suite.splits != expected:
        wanted = f"a {suite.kind} suite with the splits {', '.join(expected)}"
        raise error(suite.file, "classes", wanted, ", ".join(suite.splits), mend)
    if suite.kind == "meta" and suite.observation == "one-hot" and len({_names(suite, part) for part in SPLITS}) > 1:
        mend = 'Write observation = "masked", or give each class both splits.'
        raise error(suite.file, "observation", "masked or plain for splits of different classes", "one-hot", mend)
    if suite.train_tasks is not None:
        check_drawn(f"{suite.file}", suite.classes, suite.train_tasks)
    all_listed = all(entry.tasks for entry in suite.classes)
    if all_listed and suite.tasks_per_class is not None:
        mend = "Leave it out: every class lists its tasks."
        raise error(suite.file, "tasks_per_class", "nothing", suite.tasks_per_class, mend)
    if not all_listed and suite.tasks_per_class is None:
        mend = "Add it, or list every task."
        raise error(suite.file, "tasks_per_class", "a whole number from 0 on", "nothing", mend)
    if suite.task_id == "task" and not all_listed:
        raise error(suite.file, "task_id", '"class", since not every class lists its tasks', suite.task_id)
    for index, entry in enumerate(suite.classes):
        if entry.tasks:
            _check_listed(suite.file, f"classes[{index}].tasks", entry)


def _check_listed(file: Path, place: str, entry: SuiteClass) -> None:
    _check_unique(file, place, [task.name for task in entry.tasks])
    splits = tuple(split for split in SPLITS if any(task.of(split) for task in entry.tasks))
    if splits != entry.splits:
        mend = f"Make split of {entry.name} and of its tasks agree."
        raise error(file, place, f"tasks in {' and '.join(entry.splits)}", f"in {' and '.join(splits)}", mend)
    train, test = ([task for task in entry.tasks if task.split == split] for split in SPLITS)
    for held_out, other in product(test, train):
        if held_out.fixed == other.fixed:
            got = f"{other.name!r} and {held_out.name!r} with the same fixed values"
            raise error(file, place, "train and test tasks that differ", got, "Change one of them.")


def _check_unique(file: Path, place: str, names: list[str]) -> None:
    for name, times in Counter(names).items():
        if times > 1:
            raise error(file, f"{place}.name", "each name once", f"{name!r} {times} times", "Remove one.")

"""Suites of a single class: ``MT1-Switch-v2``, ``ML1-Switch-v2``, ``ML1-Switch-choice2`` and ``-choice4``.

They are made from the files of ``MT1-v2`` and ``ML1-v2``, with another class. In a choice suite a task is one of two or
of four, the same in both splits: both hidden numbers are small or large, alike (two) or each for itself (four).
"""

import re
from collections.abc import Iterable
from dataclasses import replace
from itertools import product

from bidex_meta.suite.contents import ListedTask, Suite

_OPENING = ("right_angle", "left_angle", 0.5, 1.2)
_CLOSING = ("right_angle", "left_angle", 0.18, 0.82)
CHOICES: dict[str, tuple[str, str, float, float]] = {
    "DoorOpenOutward": _OPENING,
    "DoorOpenInward": _OPENING,
    "DoorCloseOutward": _CLOSING,
    "DoorCloseInward": _CLOSING,
    "Switch": ("switch1_angle", "switch2_angle", 0.18, 0.48),
}
"""Classes with choice suites: the two hidden components, and their small and large value, rad."""
_NAME = re.compile(r"(MT1|ML1)-([^-]+)-(v2|choice2|choice4)")


def names_of(classes: Iterable[str]) -> list[str]:
    """Return the names of all suites of one class, for the given classes."""
    names = []
    for name in classes:
        names += [f"MT1-{name}-v2", f"ML1-{name}-v2"]
        if name in CHOICES or name == "CLASS":  # how messages name any class
            names += [f"ML1-{name}-choice2", f"ML1-{name}-choice4"]
    return names


def template_of(name: str) -> str | None:
    """Return the name of the suite from which the suite ``name`` is made; None if it is not a suite of one class."""
    match = _NAME.fullmatch(name)
    if match is None:
        return None
    return f"{match[1]}-v2"


def suite_of(name: str, template: Suite) -> Suite:
    """Return the suite ``name``, which must be among ``names_of`` some classes, made from its template."""
    match = _NAME.fullmatch(name)
    assert match is not None
    kind, class_name, variant = match.groups()
    (of_template,) = template.classes
    entry = replace(of_template, name=class_name, class_name=class_name)
    if kind == "MT1":
        return replace(template, name=name, description=f"{class_name} with fifty goals, visible", classes=(entry,))
    if variant == "v2":
        description = f"{class_name} with hidden goals: train on fifty, adapt to fifty others"
        return replace(template, name=name, description=description, classes=(entry,))
    listed = _choices(class_name, int(variant.removeprefix("choice")))
    description = f"{class_name} with one of {len(listed)} hidden goals; placements differ from episode to episode"
    return replace(
        template,
        name=name,
        description=description,
        tasks_per_class=None,
        classes=(replace(entry, tasks=listed),),
    )


def _choices(class_name: str, number: int) -> tuple[ListedTask, ...]:
    """Return two or four tasks, in both splits."""
    first, second, small, large = CHOICES[class_name]
    values = {"small": small, "large": large}
    pairs = [(name, name) for name in values] if number == 2 else list(product(values, values))
    tasks = []
    for of_first, of_second in pairs:
        name = f"{of_first}-{of_second}"
        tasks.append(ListedTask(name, "both", {first: values[of_first], second: values[of_second]}))
    return tuple(tasks)

"""Suites of a single class: ``MT1-Switch-v2``, ``ML1-Switch-v2``, ``ML1-Switch-choice2`` and ``-choice4``.

``bidex_meta.suite`` makes them from the files of ``MT1-v2`` and ``ML1-v2``. In a choice suite a task is one of two or
of four, the same in both splits: both hidden numbers are small or large, alike (two) or each for itself (four).
"""

import re
from collections.abc import Iterable
from itertools import product
from typing import NamedTuple

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
ANY_CLASS = "CLASS"
"""The name of any class in messages."""
_NAME = re.compile(r"(MT1|ML1)-([^-]+)-(v2|choice2|choice4)")


class OfOneClass(NamedTuple):
    """A suite of a single class: its name in parts."""

    template: str
    """Name of the suite that it is made from."""
    class_name: str
    choices: int
    """Number of its tasks; 0: as many as the template has."""

    @property
    def description(self) -> str:
        """Return the suite's description."""
        if self.choices:
            return f"{self.class_name} with one of {self.choices} hidden goals; placements differ between episodes"
        if self.template.startswith("MT1"):
            return f"{self.class_name} with fifty goals, visible"
        return f"{self.class_name} with hidden goals: train on fifty, adapt to fifty others"

    def tasks(self) -> dict[str, dict[str, float]]:
        """Return the fixed components of each listed task by the task's name; none if tasks are drawn."""
        if not self.choices:
            return {}
        first, second, small, large = CHOICES[self.class_name]
        values = {"small": small, "large": large}
        tasks = {}
        for of_first, of_second in product(values, values):
            if of_first == of_second or self.choices == 4:
                tasks[f"{of_first}-{of_second}"] = {first: values[of_first], second: values[of_second]}
        return tasks


def names_of(classes: Iterable[str]) -> list[str]:
    """Return the names of all suites of a single class, for the given classes."""
    names = []
    for name in classes:
        names += [f"MT1-{name}-v2", f"ML1-{name}-v2"]
        if name in CHOICES or name == ANY_CLASS:
            names += [f"ML1-{name}-choice2", f"ML1-{name}-choice4"]
    return names


def parts_of(name: str) -> OfOneClass | None:
    """Return the parts of the name of a suite of a single class; None for another suite."""
    match = _NAME.fullmatch(name)
    if match is None:
        return None
    kind, class_name, variant = match.groups()
    if variant == "v2":
        choices = 0
    else:
        choices = int(variant.removeprefix("choice"))
    return OfOneClass(f"{kind}-v2", class_name, choices)

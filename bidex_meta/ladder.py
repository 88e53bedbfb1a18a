"""Suites without a file, such as ``MT1-Switch-v2``, which shows its goals, and ``ML1-Switch-v2``, which hides them.

``bidex_meta.suite_files`` makes these suites from the files of other suites. The door classes and Switch have goals of
two angles. These classes also have suites with fewer different goals:

- ``choice2``, such as ``ML1-Switch-choice2``: two tasks. Both angles are small, or both are large.
- ``choice4``: four tasks. Each angle is small or large, independently of the other.
- ``shared``: both angles have the same value, anywhere in the class's range.

``ML2-Doors-shared`` and ``MT2-Doors-shared`` have two door classes with a shared angle.

A choice suite has the same tasks in both splits. ``MT1-Switch-choice2`` shows the goal that ``ML1-Switch-choice2``
hides: the success of a policy that is trained on the former shows what adaptation can reach in the latter.
"""

import re
from collections.abc import Iterable
from itertools import product
from typing import Literal, NamedTuple


class Choice(NamedTuple):
    """The two goal angles of a class that has choice and shared suites: names of the angles, and their values, rad."""

    first: str
    second: str
    small: float
    large: float
    lowest: float
    """Lower end of the class's range; ``highest`` is the upper end."""
    highest: float


_OPENING = Choice("right_angle", "left_angle", small=0.5, large=1.2, lowest=0.3, highest=1.4)
_CLOSING = Choice("right_angle", "left_angle", small=0.18, large=0.82, lowest=0.0, highest=1.0)
CHOICES = {
    "DoorOpenOutward": _OPENING,
    "DoorOpenInward": _OPENING,
    "DoorCloseOutward": _CLOSING,
    "DoorCloseInward": _CLOSING,
    "Switch": Choice("switch1_angle", "switch2_angle", small=0.18, large=0.48, lowest=0.1, highest=0.5585),
}
"""Classes that have choice and shared suites, each with the components that its tasks hide."""
ANY_CLASS = "CLASS"
"""Placeholder for the name of a class, in messages."""
_VARIANTS = ("choice2", "choice4", "shared")
GROUPS = {"Doors": ("DoorOpenOutward", "DoorCloseInward")}
"""Groups of classes that have suites of their own, such as ``ML2-Doors-shared``; each class has a shared angle."""
_NAME = re.compile(rf"(MT|ML)(1)-([^-]+)-(v2|{'|'.join(_VARIANTS)})|(MT|ML)(2)-({'|'.join(GROUPS)})-(shared)")
_Task = tuple[str, Literal["train", "test", "both"], dict[str, float]]
_SHARED_TASKS = 50
"""Number of tasks in each split of a shared suite. The test tasks lie midway between the train tasks."""
_STRIDE = 19
"""Number of angles from a task of a shared suite to the next task, so that the first tasks cover the whole range."""


HIDDEN_NUMBERS = {
    "BottleCap": 1, "OpenPenCap": 1, "OpenScissors": 1, "SwingCup": 1,
    "DoorCloseInward": 2, "DoorCloseOutward": 2, "DoorOpenInward": 2, "DoorOpenOutward": 2, "GraspAndPlace": 2,
    "PourWater": 2, "ReOrientation": 2, "Switch": 2,
    "CatchAbreast": 3, "CatchOver2Underarm": 3, "CatchUnderarm": 3, "HandOver": 3, "LiftUnderarm": 3, "StackBlock": 3,
    "PushBlock": 4, "TwoCatchUnderarm": 6,
}  # fmt: skip
"""Number of values that a task of a class hides in version 2, by class."""
_OF_SUITES = {"ML5-v2": 3, "ML1-v2": 4, "ML4-v2": 4, "ML20-v2": 5}


class Rung(NamedTuple):
    """A rung of the ladder: a group of suites whose tasks hide about the same amount from the policy.

    The ladder (docs/results/ladder.md) orders suites by how much their tasks hide.
    """

    hidden: str
    """Hidden part of a task, in words."""
    budget: str
    """Training time of a learner that infers goals; docs/results/ladder.md has measurements for runs on one core."""


RUNGS = (
    Rung("one of two or four goals", "about 20 minutes on one core"),
    Rung("one number", "about 30 minutes on one core"),
    Rung("two numbers", "about an hour on one core"),
    Rung("one or two numbers, several classes", "about 40 minutes on one core"),
    Rung("three numbers and more", "not measured"),
    Rung("all that version 2 hides", "about two hours on one core, with teachers"),
)


class Parts(NamedTuple):
    """The parsed name of a suite without a file."""

    template: str
    """Name of the suite that this suite is made from."""
    subject: str
    """Name of the class or of the group of classes."""
    variant: str
    """Kind of goals: ``v2`` (as in the template), ``choice2``, ``choice4`` or ``shared``."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Return the names of the suite's classes."""
        return GROUPS.get(self.subject, (self.subject,))

    @property
    def shows_goals(self) -> bool:
        """Return whether observations show the goal; such a suite only has a train split."""
        return self.template.startswith("MT")

    @property
    def description(self) -> str:
        """Return the suite's description."""
        sight = "visible" if self.shows_goals else "hidden"
        if self.subject in GROUPS:
            return f"{' and '.join(self.classes)} with one {sight} angle that both leaves share"
        if self.variant.startswith("choice"):
            number = self.variant.removeprefix("choice")
            return f"{self.subject} with one of {number} {sight} goals; placements differ between episodes"
        if self.variant == "shared":
            return f"{self.subject} with one {sight} angle that both parts share"
        if self.shows_goals:
            return f"{self.subject} with fifty goals, visible"
        return f"{self.subject} with hidden goals; fifty train tasks and fifty other test tasks"

    def tasks(self, class_name: str) -> list[_Task]:
        """Return the tasks that the suite lists for one of its classes; an empty list if its tasks are drawn.

        Each task is a tuple of its name, its split, and the values of the goal's components, rad, by name.
        """
        if self.variant == "v2":
            return []
        choice = CHOICES[class_name]
        if self.variant == "shared":
            return self._shared_tasks(choice)
        values = {"small": choice.small, "large": choice.large}
        tasks = []
        for of_first, of_second in product(values, values):
            if of_first == of_second or self.variant == "choice4":
                fixed = {choice.first: values[of_first], choice.second: values[of_second]}
                tasks.append((f"{of_first}-{of_second}", "both", fixed))
        return tasks

    def _shared_tasks(self, choice: Choice) -> list[_Task]:
        """Return the tasks of a class in which both angles of the goal are equal.

        The tasks of a split are evenly spaced over the class's range of angles. Test tasks lie midway between train
        tasks. The order is not that of the angles, because evaluations may play only the first tasks. A suite that
        shows its goals plays the test tasks only as unseen tasks.
        """
        tasks = []
        for place in range(_SHARED_TASKS):
            number = place * _STRIDE % _SHARED_TASKS
            for split in ("train", "test"):
                share = (number + 0.25 + 0.5 * (split == "test")) / _SHARED_TASKS
                angle = choice.lowest + share * (choice.highest - choice.lowest)
                tasks.append((f"{split}-{number:02}", split, {choice.first: angle, choice.second: angle}))
        return tasks


def rung_of(name: str, classes: Iterable[str]) -> int | None:
    """Return the rung of a suite as an index in ``RUNGS``, which orders suites by how much their tasks hide.

    ``classes`` are the suite's train classes. The result is None unless the suite is a shipped one that hides its goals
    by the rules of version 2.
    """
    if name in _OF_SUITES:
        return _OF_SUITES[name]
    parts = parts_of(name)
    if parts is None or parts.shows_goals:
        return None
    if parts.variant.startswith("choice"):
        return 0
    if parts.variant == "shared":
        return 3 if parts.subject in GROUPS else 1
    numbers = max(HIDDEN_NUMBERS[each] for each in classes)
    return {1: 1, 2: 2}.get(numbers, 4)


def names_of(classes: Iterable[str]) -> list[str]:
    """Return the names of all suites without a file: those of each of the given classes, and those of groups."""
    names = []
    for subject, group in GROUPS.items():
        names += [f"MT{len(group)}-{subject}-shared", f"ML{len(group)}-{subject}-shared"]
    for name in classes:
        for kind in ("MT1", "ML1"):
            names.append(f"{kind}-{name}-v2")
            if name in CHOICES or name == ANY_CLASS:
                names += [f"{kind}-{name}-{variant}" for variant in _VARIANTS]
    return names


def parts_of(name: str) -> Parts | None:
    """Return the parts of the name of a suite without a file; None for any other name."""
    match = _NAME.fullmatch(name)
    if match is None:
        return None
    kind, count, subject, variant = (part for part in match.groups() if part is not None)
    template = "1-v2" if count == "1" else "5-v2"
    return Parts(f"{kind}{template}", subject, variant)

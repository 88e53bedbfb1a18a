"""The task classes by name; ``package.module:Class`` names a user's class."""

import importlib
import inspect
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bidex_meta.errors import BidexError, known_name, unknown_name
from bidex_meta.rules import V2, plain_name, versioned_name
from bidex_meta.utils.arguments import check_attributes
from bidex_meta.utils.plugins import is_outside, outside_class
from bidex_meta.utils.validation import true_or_false

if TYPE_CHECKING:
    from bidex_meta.tasks.base import TaskClass

# Modules are imported at first use, because listing names must not import torch and mujoco.
_MODULES = {
    "HandOver": "catches", "CatchUnderarm": "catches", "CatchOver2Underarm": "catches",
    "TwoCatchUnderarm": "catches", "CatchAbreast": "catches", "LiftUnderarm": "vessels",
    "DoorOpenOutward": "doors", "DoorOpenInward": "doors", "DoorCloseOutward": "doors", "DoorCloseInward": "doors",
    "BottleCap": "vessels", "PushBlock": "cubes", "SwingCup": "vessels", "OpenScissors": "articulated",
    "ReOrientation": "cubes", "OpenPenCap": "articulated", "Switch": "articulated", "StackBlock": "cubes",
    "PourWater": "bucket", "GraspAndPlace": "bucket",
}  # fmt: skip

_OF_INSTANCE = "variation_space"
"""Attribute that a class may also set in ``__init__``, as EggTask does."""


def names() -> list[str]:
    """Return the names of all task classes, in the order of the appendix."""
    return list(_MODULES)


def module_of(name: str) -> str:
    """Return the module name of a class in ``names``; the module need not be imported yet."""
    return f"bidex_meta.tasks.{_MODULES[name]}"


def name_among(name: str, classes: Mapping[str, "TaskClass"]) -> str:
    """Return the key of the class called ``name`` in ``classes``, the classes of a suite by name.

    In suites of version 2 ``Switch-v2`` and ``Switch`` are the same class. An unknown name is returned as it is.
    """
    plain = plain_name(name)
    written = list(classes)
    if name not in written and plain in written and classes[plain].rules == V2:
        return plain
    return name


def resolve(name: str, kind: str = "task class") -> str:
    """Return a class's name in the exact spelling that ``get`` accepts.

    The case of names of shipped classes is ignored, but not the case of ``package.module:Class``. The name may end in
    ``-v2``.

    Raises BidexError if there is no such class; the error message calls the class a ``kind``.
    """
    plain = plain_name(str(name))
    has_version = plain != str(name)
    if is_outside(name):
        _outside(plain)
    else:
        plain = known_name(kind, plain, names())
    if has_version:
        return versioned_name(plain, V2)
    return plain


def with_object(name: str | None) -> dict[str, str]:
    """Return the keyword arguments of ``get`` that choose this object: ``{"object": name}``, or ``{}`` for None."""
    return {} if name is None else {"object": name}


def check_object(name: object) -> None:
    """Raise BidexError if an object is called ``v2``.

    In a class name such as ``CatchUnderarm-v2``, the ending would be read as version 2 instead of the object.
    """
    if isinstance(name, str) and Path(name).stem.casefold() == "v2":
        raise BidexError(f"object: expected a name other than v2, which stands for a version, got {name!r}. Rename it.")


def get(name: str, moving_base: bool | None = None, touch: bool = False, **options: float | str) -> "TaskClass":
    """Return an instance of a task class, which is named as ``CatchUnderarm`` or as ``package.module:Class``.

    docs/own-task.md explains the second form. The name ``CatchUnderarm-v2`` gives the class the rules of version 2.
    With ``moving_base`` actions drive the hands' bases (52 actions); if it is False, the bases are fixed (40 actions).
    None takes the class's default. With ``touch`` the hands have touch sensors, which observations show. ``options``
    depend on the class, e.g. ``water=30`` for PourWater or ``object="block"`` for CatchUnderarm.

    Raises BidexError if there is no such class or option; the message gives the nearest name and the list.
    """
    plain = plain_name(name)
    if is_outside(name):
        task_class = _outside(plain)
    elif plain in _MODULES:
        task_class = vars(importlib.import_module(module_of(plain)))[plain]
    else:
        raise unknown_name("task class", name, _MODULES)
    known = dict(list(inspect.signature(task_class).parameters.items())[1:])
    for option in options:
        if option not in known:
            raise unknown_name(f"option of {name}", option, known)
    check_object(options.get("object"))
    made = task_class(moving_base, **options)
    if not hasattr(made, _OF_INSTANCE):
        _check_has(name, [_OF_INSTANCE])
    made.touch = true_or_false("touch", touch)
    made.chosen = {option: parameter.default for option, parameter in known.items()} | options
    if name != plain:
        made.adopt(V2)
    return made


def _outside(name: str) -> "type[TaskClass]":
    from bidex_meta.tasks.base import TaskClass  # listing names must not import torch and mujoco

    found, _ = outside_class(name, "task")
    if not issubclass(found, TaskClass):
        raise BidexError(f"task {name}: expected a subclass of bidex_meta.tasks.base.TaskClass, got {found!r}.")
    attributes = TaskClass.__annotations__.keys() - {_OF_INSTANCE}
    _check_has(name, [*sorted(found.__abstractmethods__), *sorted(x for x in attributes if not hasattr(found, x))])
    check_attributes(found, TaskClass, f"task {name}")
    return found


def _check_has(name: str, missing: Sequence[str]) -> None:
    if missing:
        raise BidexError(f"task {name}: expected the class to have {', '.join(missing)}. See docs/own-task.md.")

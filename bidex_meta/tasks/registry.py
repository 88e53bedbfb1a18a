"""The task classes by name: one dict."""

import importlib
import inspect
from typing import TYPE_CHECKING

from bidex_meta.errors import unknown_name

if TYPE_CHECKING:
    from bidex_meta.tasks.base import TaskClass

# Modules by name, imported at first use: listing names must not import torch and mujoco.
_MODULES = {
    "HandOver": "hand_over",
    "CatchUnderarm": "catch_underarm",
    "CatchOver2Underarm": "catch_over2underarm",
    "TwoCatchUnderarm": "two_catch_underarm",
    "CatchAbreast": "catch_abreast",
    "LiftUnderarm": "lift_underarm",
    "DoorOpenOutward": "doors",
    "DoorOpenInward": "doors",
    "DoorCloseOutward": "doors",
    "DoorCloseInward": "doors",
    "BottleCap": "bottle_cap",
    "PushBlock": "push_block",
    "SwingCup": "swing_cup",
    "OpenScissors": "open_scissors",
    "ReOrientation": "re_orientation",
    "OpenPenCap": "open_pen_cap",
    "Switch": "switch",
    "StackBlock": "stack_block",
    "PourWater": "pour_water",
    "GraspAndPlace": "grasp_and_place",
}


def names() -> list[str]:
    """Names of all task classes, in the order of the appendix."""
    return list(_MODULES)


def get(name: str, moving_base: bool | None = None, **options: float) -> "TaskClass":
    """A task class.

    Args:
        name: Its name, e.g. ``CatchUnderarm``.
        moving_base: Drive the hands' bases (52 actions) or fix them (40); None takes the class's own.
        options: What else the class lets one choose, e.g. ``water=30`` for PourWater.

    Raises:
        BidexError: There is no such class or option; the message gives the nearest name and the list.
    """
    if name not in _MODULES:
        raise unknown_name("task class", name, _MODULES)
    module = importlib.import_module(f"bidex_meta.tasks.{_MODULES[name]}")
    task_class = getattr(module, name)
    known = list(inspect.signature(task_class).parameters)[1:]
    for option in options:
        if option not in known:
            raise unknown_name(f"option of {name}", option, known)
    return task_class(moving_base, **options)

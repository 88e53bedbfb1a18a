"""The task classes by name: one dict."""

import importlib
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
}


def names() -> list[str]:
    """Names of all task classes, in the order of the appendix."""
    return list(_MODULES)


def get(name: str, moving_base: bool | None = None) -> "TaskClass":
    """A task class.

    Args:
        name: Its name, e.g. ``CatchUnderarm``.
        moving_base: Drive the hands' bases (52 actions) or fix them (40); None takes the class's own.

    Raises:
        BidexError: There is no such class; the message gives the nearest name and the list.
    """
    if name not in _MODULES:
        raise unknown_name("task class", name, _MODULES)
    module = importlib.import_module(f"bidex_meta.tasks.{_MODULES[name]}")
    return getattr(module, name)(moving_base)

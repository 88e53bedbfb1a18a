"""Classes of the user's own by name: ``package.module:Class``, installed or in the working folder."""

import importlib
import os
import sys
from pathlib import Path
from typing import Any

from bidex_meta.errors import BidexError


def is_outside(name: object) -> bool:
    """Whether a name is of the form ``package.module:Class``."""
    return isinstance(name, str) and ":" in name


def short_name(name: str) -> str:
    """The class's name of ``package.module:Class``; any other name as it is."""
    return name.rpartition(":")[2]


def name_with_object(name: str, thing: str | None) -> str:
    """What a task class with another object is called: ``CatchUnderarm-block``; of a file its name without ``.xml``."""
    # Names of the shelf are taken in any case, and written in one.
    return name if thing is None else f"{name}-{Path(thing).stem if thing.endswith('.xml') else thing.lower()}"


def name_without_object(name: str) -> str:
    """The task class of a name that ``name_with_object`` made."""
    return name.partition("-")[0]


def outside_class(name: str, role: str) -> tuple[type[Any], Any]:
    """A class of the user's own, and the module it stands in.

    Args:
        name: ``package.module:Class``.
        role: What was named, for messages, e.g. ``--algo``.

    Raises:
        BidexError: There is no such module or class.
    """
    module_name, _, class_name = name.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # a console script does not look there by itself
    try:
        module = importlib.import_module(module_name)
    except (ModuleNotFoundError, ValueError, TypeError) as error:  # the latter two: an empty or a relative name
        missing = getattr(error, "name", None) or module_name
        raise BidexError(
            f"{role} {name}: expected a module that can be imported, but there is no {missing}. Install its "
            "package, or start in the folder that holds it."
        ) from error
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        raise BidexError(f"{role} {name}: expected a class {class_name} in {module.__file__}, found none.")
    return found, module

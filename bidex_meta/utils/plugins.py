"""Import of users' own classes by name: ``package.module:Class``, which is installed or in the working folder."""

import importlib
import importlib.util
import os
import sys
import traceback
from pathlib import Path
from types import ModuleType

from bidex_meta.errors import BidexError

_files: dict[str, str] = {}
"""Files from which users' classes were imported, each with the flag and the name that the user gave, for messages."""


def is_outside(name: object) -> bool:
    """Return whether a name is of the form ``package.module:Class``."""
    return isinstance(name, str) and ":" in name


def short_name(name: str) -> str:
    """Return the class's name of ``package.module:Class``; return any other name unchanged."""
    return name.rpartition(":")[2]


def name_with_object(name: str, thing: str | None) -> str:
    """Return the name of a task class whose object is replaced, such as ``CatchUnderarm-block``.

    ``thing`` is the name of an object, or an MJCF file of which the name without ``.xml`` is used. If it is None, the
    class name is returned unchanged.
    """
    # Names of the shelf are taken in any case, and written in one.
    if thing is None:
        return name
    return f"{name}-{Path(thing).stem if thing.endswith('.xml') else thing.lower()}"


def name_without_object(name: str) -> str:
    """Return the task class of a name that ``name_with_object`` made."""
    return name.partition("-")[0]


def outside_class(name: str, role: str) -> tuple[type, ModuleType]:
    """Import a user's own class by its name, ``package.module:Class``; return the class and its module.

    ``role`` is for messages, e.g. ``--algo``. Raises BidexError if module or class do not exist, or the import raises.
    """
    module_name, _, class_name = name.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # a console script does not search the current folder by default
    try:
        spec = importlib.util.find_spec(module_name)
        if spec is not None and spec.origin is not None:
            _files[spec.origin] = f"{role} {name}"
        module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:
        message = own_fault(error)
        # Python raises ValueError and TypeError for an empty or a relative name.
        absent = isinstance(error, ModuleNotFoundError)
        if absent or (message is None and isinstance(error, ValueError | TypeError)):
            missing = (error.name if absent else None) or module_name
            message = (
                f"{role} {name}: expected a module that can be imported, but there is no {missing}. Install its "
                "package, or start in the folder that holds it."
            )
        raise BidexError(message or f"{role} {name}: {_said(error)}.") from error
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        raise BidexError(f"{role} {name}: expected a class {class_name} in {module.__file__}, found none.")
    return found, module


def own_fault(error: BaseException) -> str | None:
    """Return message and location of an error from a user's own class or code that it calls; None for other errors."""
    at = [(frame.filename, frame.lineno) for frame in traceback.extract_tb(error.__traceback__)]
    if isinstance(error, SyntaxError):
        at.append((error.filename or "", error.lineno))
    for file, line in reversed(at):
        if file in _files:
            return f"{_files[file]}: {_said(error)} ({file}, line {line})."
    # Python refuses wrong arguments before the first line of the function runs.
    asked = [(short_name(name), file, name) for file, name in _files.items()]
    found = [(file, name) for each, file, name in asked if isinstance(error, TypeError) and f"{each}." in str(error)]
    if found:
        return f"{found[-1][1]}: {_said(error)} ({found[-1][0]})."
    return None


def _said(error: BaseException) -> str:
    words = (error.msg if isinstance(error, SyntaxError | ImportError) else None) or str(error)
    return f"{type(error).__name__}: {words}".rstrip(": .")

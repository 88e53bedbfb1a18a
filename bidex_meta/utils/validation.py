"""What comes from outside, checked by the annotations of dataclasses: settings, flags and files alike.

msgspec does the checking. A dataclass says in its annotations what its fields may be (the types below have the usual
bounds); :func:`check_fields` checks an instance, :func:`parse` makes one of what was read from a file. Whatever is
wrong is one line that names the field, what was expected and what came.
"""

import dataclasses
import functools
import math
import operator
import re
import types
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints, is_typeddict

import msgspec
import numpy as np
from msgspec import Meta

from bidex_meta.errors import BidexError, nearest, shortened

Kind = TypeVar("Kind")

MOST = 10**12
"""No count of anything is larger."""
_LARGE = 1e300

Whole = Annotated[int, Meta(ge=0, le=MOST)]
"""A count that may be zero."""
Count = Annotated[int, Meta(ge=1, le=MOST)]
"""A count of at least one."""
Few = Annotated[int, Meta(ge=1, le=1_000_000)]
"""Episodes, tasks, trials, images: what is done so many times."""
Shots = Annotated[int, Meta(ge=0, le=1000)]
"""Adaptations one after the other."""
Environments = Annotated[int, Meta(ge=1, le=10_000_000)]
"""Environments stepped together."""
Threads = Annotated[int, Meta(ge=1, le=4096)]
"""Threads; a resumed run may have more than there are cores."""
Pixels = Annotated[int, Meta(ge=1, le=16_384)]
"""Width or height of an image."""
Port = Annotated[int, Meta(ge=1, le=65_535)]
"""A port of this machine."""
Seed = Annotated[int, Meta(ge=0, le=2**63 - 1)]
"""A seed."""
Width = Annotated[int, Meta(ge=1, le=65_536)]
"""Width of a network's layer; so wide a one alone holds 17 GB."""
Widths = Annotated[tuple[Width, ...], Meta(min_length=1, max_length=64)]
"""Widths of a network's hidden layers, at least one."""
Finite = Annotated[float, Meta(ge=-_LARGE, le=_LARGE)]
"""A finite number."""
Positive = Annotated[float, Meta(gt=0.0, le=_LARGE)]
"""A finite number above 0."""
NonNegative = Annotated[float, Meta(ge=0.0, le=_LARGE)]
"""A finite number, 0 or more."""
Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]
"""A number from 0 to 1."""
Share = Annotated[float, Meta(gt=0.0, le=1.0)]
"""A number above 0, to 1."""
BelowOne = Annotated[float, Meta(ge=0.0, lt=1.0)]
"""A number from 0 to below 1."""
Text = Annotated[str, Meta(min_length=1, max_length=4096, pattern=r"^[^\0]*$")]
"""A text that is not empty."""


class Checked:
    """Base of a dataclass of settings: its fields are checked by their annotations when an instance is made.

    A class with conditions between fields checks them in its own ``__post_init__``, after this one.

    Raises:
        BidexError: A field is not of its type or out of its bounds.
    """

    def __post_init__(self) -> None:
        """Checks all fields."""
        check_fields(self, getattr(self, "algo", type(self).__name__))


def check_fields(settings: Any, name: str, as_flags: bool = False) -> None:
    """Refuses an instance of a dataclass with a field that is not of its annotation.

    Args:
        settings: The instance; fields whose annotation is no plain type (a path, a function) are left alone.
        name: What messages call it.
        as_flags: Whether messages name the field as a flag of the command line.

    Raises:
        BidexError: Names the first such field.
    """
    for field, hint in _hints(type(settings)).items():
        value = getattr(settings, field)
        try:
            msgspec.convert(value, hint)
        except msgspec.ValidationError as error:
            shown = f"--{field.replace('_', '-')}" if as_flags else field
            raise BidexError(f"{name}: {_message(error, value, hint, shown)}") from None


def check_rising(settings: Any, name: str, *fields: str) -> None:
    """Refuses pairs of numbers of which the second is smaller than the first.

    Raises:
        BidexError: Names the first such field.
    """
    for field in fields:
        low, high = getattr(settings, field)
        if low > high:
            raise BidexError(f"{name}: {field}: expected two rising numbers, got {low} {high}.")


def parse(content: object, kind: type[Kind], where: str, exact: bool = False) -> Kind:
    """What was read from a file as an instance of a type.

    Args:
        content: Dicts, lists, texts, numbers, as JSON or TOML give them.
        kind: A dataclass, or another type that msgspec knows; fields without a default must be there.
        where: File and place in it, for messages.
        exact: Whether names that no field has are refused.

    Raises:
        BidexError: Names the first entry that is not what it must be.
    """
    try:
        if exact:
            _refuse_unknown(content, kind, where)
        return msgspec.convert(content, kind)
    except msgspec.ValidationError as error:
        raise BidexError(f"{where}: {_message(error, content, kind)}") from None


def whole_number(name: str, value: object, least: int, most: int | None = None) -> int:
    """A whole number within bounds, of whatever integer type; for arguments of functions.

    Args:
        name: What it is, for the message.
        value: What was given.
        least: Lower bound.
        most: Upper bound, or None.

    Raises:
        BidexError: Not a whole number (1.0, True and "1" are none), or out of bounds.
    """
    try:
        number = None if isinstance(value, bool) else operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        number = None
    if number is None or number < least or (most is not None and number > most):
        bounds = f"from {least} on" if most is None else f"from {least} to {most}"
        raise BidexError(f"{name}: expected a whole number {bounds}, got {shortened(value)}.")
    return number


def true_or_false(name: str, value: object) -> bool:
    """A truth value, Python's or NumPy's; for arguments of functions.

    Raises:
        BidexError: Neither true nor false; no other value stands for one.
    """
    if not isinstance(value, bool | np.bool_):
        raise BidexError(f"{name}: expected True or False, got {shortened(value)}.")
    return bool(value)


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    """The annotations of a dataclass's fields that msgspec can check."""
    hints = get_type_hints(kind, include_extras=True)
    return {f.name: hints[f.name] for f in dataclasses.fields(kind) if _plain(hints[f.name])}


def _plain(hint: Any) -> bool:
    if get_origin(hint) is Annotated:
        return _plain(get_args(hint)[0])
    if get_origin(hint) is Literal:
        return True
    if get_origin(hint) in (tuple, list, dict, Union, types.UnionType):
        return all(_plain(part) for part in get_args(hint))
    return hint in (bool, int, float, str, type(None), Ellipsis)


def _refuse_unknown(content: object, kind: Any, where: str, place: str = "") -> None:
    """Refuses names in tables that no field of their dataclass has, with the nearest one."""
    if get_origin(kind) is Annotated:
        _refuse_unknown(content, get_args(kind)[0], where, place)
    elif dataclasses.is_dataclass(kind) and isinstance(content, dict):
        hints = get_type_hints(kind, include_extras=True)
        known = [field.name for field in dataclasses.fields(kind)]
        for name, value in content.items():
            if name not in known:
                near = nearest(str(name), known)
                hint = f"did you mean {near!r}?" if near else f"known: {', '.join(known)}."
                raise BidexError(f"{where}: {place}{name}: unknown entry, {hint}")
            _refuse_unknown(value, hints[name], where, f"{place}{name}.")
    elif get_origin(kind) in (Union, types.UnionType):
        for part in get_args(kind):
            _refuse_unknown(content, part, where, place)
    elif get_origin(kind) in (tuple, list) and isinstance(content, list):
        for number, value in enumerate(content):
            _refuse_unknown(value, get_args(kind)[0], where, f"{place.rstrip('.')}[{number}].")
    elif get_origin(kind) is dict and isinstance(content, dict):
        for name, value in content.items():
            _refuse_unknown(value, get_args(kind)[1], where, f"{place}{name}.")


def _message(error: msgspec.ValidationError, content: object, kind: Any, field: str = "") -> str:
    """Msgspec's complaint as ``place: expected ..., got ....``."""
    complaint, _, path = str(error).rpartition(" - at `$") if " - at `$" in str(error) else (str(error), "", "")
    path = path.rstrip("`")
    place = (field + path).removeprefix(".")
    if isinstance(error.__cause__, BidexError):  # of a dataclass that checks more than its annotations
        return str(error.__cause__)
    missing = re.fullmatch(r"Object missing required field `(.*)`", complaint)
    if missing:
        return f"{place}{'.' if place else ''}{missing[1]}: expected it to be there, found none."
    value = _at(content, path)
    if complaint.startswith("Invalid enum value"):
        expected = f"expected one of {', '.join(map(str, _choices(_annotation_at(kind, path))))}"
    elif isinstance(value, float) and not math.isfinite(value):
        expected = "expected a finite number"
    else:
        expected = complaint.partition(", got ")[0].replace("`", "").replace("Expected", "expected")
        for ours, theirs in _WORDS.items():
            expected = re.sub(rf"\b{theirs}\b", ours, expected)
        expected = expected.replace(f" <= {_LARGE:.0e}", "")
    got = "" if value is dataclasses.MISSING else f", got {shortened(value)}"
    return f"{place or 'content'}: {expected}{got}."


_WORDS = {
    "a table": "object",
    "a list": "array",
    "a whole number": "int",
    "a number": "float",
    "a text": "str",
    "true or false": "bool",
}
"""Our words for msgspec's."""


def _choices(hint: Any) -> list[Any]:
    """All values that literals within an annotation allow."""
    if get_origin(hint) is Literal:
        return list(get_args(hint))
    return [value for part in get_args(hint) if not isinstance(part, Meta) for value in _choices(part)]


_STEP = re.compile(r"\.([^.\[]+)|\[([^\]]*)\]")
"""A part of msgspec's path, such as ``.runs[0].name``; ``[...]`` where it does not say which."""


def _at(content: object, path: str) -> object:
    """The value at a path; MISSING where that cannot be said."""
    try:
        for name, number in _STEP.findall(path):
            content = content[name] if name else content[int(number)]  # type: ignore[index]
        return content
    except (LookupError, TypeError, ValueError):
        return dataclasses.MISSING


def _annotation_at(kind: Any, path: str) -> Any:
    """The annotation of the value at a path."""
    for name, _ in _STEP.findall(path):
        parts = [kind]
        while parts and name and not (dataclasses.is_dataclass(parts[0]) or is_typeddict(parts[0])):
            parts = [*parts[1:], *(each for each in get_args(parts[0]) if not isinstance(each, Meta))]
        if name:
            kind = get_type_hints(parts[0], include_extras=True).get(name) if parts else None
        else:
            kind = get_args(kind)[-1 if get_origin(kind) is dict else 0] if get_args(kind) else None
    return kind

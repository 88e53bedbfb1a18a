"""Settings, flags and files, checked by msgspec against the annotations of dataclasses.

:func:`check_fields` checks an instance; :func:`parse` makes an instance from the content of a file. An error is one
line with the field, the expected values and the value that came.
"""

import dataclasses
import functools
import itertools
import math
import operator
import os
import re
import types
from collections.abc import Collection
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints, is_typeddict

import msgspec
import numpy as np
from msgspec import Meta

from bidex_meta.errors import BidexError, nearest, shortened

Kind = TypeVar("Kind")

MOST = 10**12  # no count is larger than this
_LARGE = 1e300

Whole = Annotated[int, Meta(ge=0, le=MOST)]
Count = Annotated[int, Meta(ge=1, le=MOST)]
Few = Annotated[int, Meta(ge=1, le=1_000_000)]  # repetitions: episodes, tasks, trials, images
Shots = Annotated[int, Meta(ge=0, le=1000)]  # adaptation rounds, one after the other
Environments = Annotated[int, Meta(ge=1, le=10_000_000)]
Threads = Annotated[int, Meta(ge=1, le=4096)]  # a resumed run may have more threads than the machine has cores
Pixels = Annotated[int, Meta(ge=1, le=16_384)]
Port = Annotated[int, Meta(ge=1, le=65_535)]
Seed = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Width = Annotated[int, Meta(ge=1, le=65_536)]  # of a network layer; two such layers in a row take 17 GB
Widths = Annotated[tuple[Width, ...], Meta(min_length=1, max_length=64)]
Finite = Annotated[float, Meta(ge=-_LARGE, le=_LARGE)]
Point = tuple[Finite, Finite, Finite]  # a position in the world frame, metres
Positive = Annotated[float, Meta(gt=0.0, le=_LARGE)]
NonNegative = Annotated[float, Meta(ge=0.0, le=_LARGE)]
Seconds = Annotated[float, Meta(ge=0.0)]  # may be infinite
Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]
Share = Annotated[float, Meta(gt=0.0, le=1.0)]
BelowOne = Annotated[float, Meta(ge=0.0, lt=1.0)]
Text = Annotated[str, Meta(min_length=1, max_length=4096, pattern=r"^[^\0]*$")]


class Checked:
    """Base of a dataclass of settings: raises BidexError for fields that do not fit their annotations.

    A class with conditions between fields checks them in its own ``__post_init__``, after it has called the method of
    this base class.
    """

    def __post_init__(self) -> None:
        check_fields(self, getattr(self, "algo", type(self).__name__))


def check_fields(settings: object, name: str, as_flags: bool = False, unresolved: Collection[str] = ()) -> None:
    """Raise BidexError for the first field of a dataclass's instance that does not fit its annotation.

    Fields whose annotation is not a plain type (such as a path or a function) are not checked. Messages call the
    instance ``name``; with ``as_flags`` they name the field as a flag of the command line. Fields in ``unresolved`` may
    be None. Paths and NumPy numbers in fields become strings and Python's numbers.
    """
    for field, hint in _hints(type(settings)).items():
        value = builtin(getattr(settings, field))
        object.__setattr__(settings, field, value)  # the dataclass may be frozen
        if value is None and field in unresolved:
            continue
        try:
            msgspec.convert(value, hint)
        except msgspec.ValidationError as error:
            if as_flags:
                shown = f"--{field.replace('_', '-')}"
            else:
                shown = field
            raise BidexError(f"{name}: {_message(error, value, hint, shown)}") from None


def builtin(value: Any) -> Any:
    """Return paths as strings and NumPy numbers as Python's, also within tuples, lists and dicts."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, np.generic):
        return value.item()
    if type(value) in (tuple, list):
        return type(value)(map(builtin, value))
    if type(value) is dict:
        return {key: builtin(each) for key, each in value.items()}
    return value


def refuse_unused(settings: Any, names: Collection[str], where: str) -> None:
    """Raise BidexError if a field in ``names`` differs from its default, because the field has no effect.

    ``where`` says in which case these fields have no effect.
    """
    for field in dataclasses.fields(settings):
        if field.name in names and getattr(settings, field.name) != field.default:
            raise BidexError(f"--{field.name.replace('_', '-')} has no effect {where}. Leave it out.")


def check_rising(settings: object, name: str, *fields: str) -> None:
    """Raise BidexError if a field that holds a pair of numbers has a second number smaller than the first.

    ``fields`` are the names of the fields that are checked; ``name`` begins the message.
    """
    for field in fields:
        low, high = getattr(settings, field)
        if low > high:
            raise BidexError(f"{name}: {field}: expected two rising numbers, got {low} {high}.")


def check_within(settings: object, name: str, field: str, bounds: str) -> None:
    """Raise BidexError if the number in ``field`` is outside the pair of numbers in ``bounds``, both field names."""
    low, high = getattr(settings, bounds)
    value = getattr(settings, field)
    if not low <= value <= high:
        raise BidexError(f"{name}: {field}: expected a number within {bounds}, {low} to {high}, got {value}.")


def parse(content: object, kind: type[Kind], where: str, exact: bool = False) -> Kind:
    """Return the content of a file (JSON or TOML) as an instance of a dataclass or another type.

    Raises BidexError for the first entry that does not fit, and with ``exact`` also for unknown names. ``where``, the
    file and the location in it, begins the message.
    """
    try:
        if exact:
            _refuse_unknown(content, kind, where)
        return msgspec.convert(content, kind)
    except msgspec.ValidationError as error:
        raise BidexError(f"{where}: {_message(error, content, kind)}") from None


def whole_number(name: str, value: object, least: int, most: int | None = None) -> int:
    """Return an argument of any integer type as an int within bounds.

    Raises BidexError if the argument is not an integer (1.0, True and "1" are not integers), or is out of bounds.
    """
    try:
        number = None if isinstance(value, bool) else operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        number = None
    if number is None or number < least or (most is not None and number > most):
        if most is None:
            bounds = f"from {least} on"
        else:
            bounds = f"from {least} to {most}"
        raise BidexError(f"{name}: expected a whole number {bounds}, got {shortened(value)}.")
    return number


def true_or_false(name: str, value: object) -> bool:
    """Return a Python or NumPy bool as a Python bool; raises BidexError for any other value."""
    if not isinstance(value, bool | np.bool_):
        raise BidexError(f"{name}: expected True or False, got {shortened(value)}.")
    return bool(value)


def real_numbers(name: str, value: object, dimensions: int) -> np.ndarray:
    """Return an argument as an array of float64 numbers, always a copy.

    Raises BidexError unless the argument is an array of real numbers with ``dimensions`` dimensions.
    """
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError):  # lists of unequal lengths, or tensors of an accelerator
        array = np.array(None)
    if array.dtype.kind not in "fiu" or array.ndim != dimensions:
        if array.dtype.kind in "fiu":
            got = f"shape {array.shape}"
        else:
            got = shortened(value)
        raise BidexError(
            f"{name}: expected an array of numbers of {dimensions} dimension{'s' * (dimensions > 1)}, got {got}."
        )
    return array.astype(np.float64)


@functools.cache
def _hints(kind: type) -> dict[str, object]:
    """Return the annotations of a dataclass's fields that msgspec can check."""
    hints = get_type_hints(kind, include_extras=True)
    return {f.name: hints[f.name] for f in dataclasses.fields(kind) if _plain(hints[f.name])}


def _plain(hint: object) -> bool:
    if get_origin(hint) is Annotated:
        return _plain(get_args(hint)[0])
    if get_origin(hint) is Literal:
        return True
    if get_origin(hint) in (tuple, list, dict, Union, types.UnionType):
        return all(_plain(part) for part in get_args(hint))
    return hint in (bool, int, float, str, type(None), Ellipsis)


def _refuse_unknown(content: object, kind: object, where: str, place: str = "") -> None:
    """Raise BidexError for the first name in a table that is not a field of the dataclass ``kind``.

    The message suggests the most similar field, or lists all fields.
    """
    if get_origin(kind) is Annotated:
        _refuse_unknown(content, get_args(kind)[0], where, place)
    elif dataclasses.is_dataclass(kind) and isinstance(content, dict):
        hints = get_type_hints(kind, include_extras=True)
        known = [field.name for field in dataclasses.fields(kind)]
        for name, value in content.items():
            if name not in known:
                near = nearest(str(name), known)
                if near:
                    hint = f"did you mean {near!r}?"
                else:
                    hint = f"known: {', '.join(known)}."
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


def _message(error: msgspec.ValidationError, content: object, kind: object, field: str = "") -> str:
    """Rewrite msgspec's message as ``place: expected ..., got ....``."""
    complaint, found, path = str(error).rpartition(" - at `$")
    if not found:
        complaint = str(error)
        path = ""
    path = path.rstrip("`")
    place = (field + path).removeprefix(".")
    if isinstance(error.__cause__, BidexError):  # a dataclass raised it in a check beyond its annotations
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
    if value is dataclasses.MISSING:
        got = ""
    else:
        got = f", got {shortened(value)}"
    return f"{place or 'content'}: {expected}{got}."


# These are our words for msgspec's terms.
_WORDS = {"a table": "object", "a list": "array", "a whole number": "int", "a number": "float", "a text": "str"}
_WORDS |= {"true or false": "bool"}


def _choices(hint: object) -> list[object]:
    """Return all values that literals within an annotation allow."""
    if get_origin(hint) is Literal:
        return list(get_args(hint))
    parts = [part for part in get_args(hint) if not isinstance(part, Meta)]
    return list(itertools.chain.from_iterable(map(_choices, parts)))


# This matches a part of msgspec's path, such as ``.runs[0].name``; ``[...]`` stands for an unknown index.
_STEP = re.compile(r"\.([^.\[]+)|\[([^\]]*)\]")


def _at(content: object, path: str) -> object:
    """Return the value at one of msgspec's paths, such as ``.runs[0].name``; MISSING if the path leads to no value."""
    try:
        for name, number in _STEP.findall(path):
            content = content[name] if name else content[int(number)]  # type: ignore[index]
        return content
    except (LookupError, TypeError, ValueError):
        return dataclasses.MISSING


def _annotation_at(kind: object, path: str) -> object:
    """Return the annotation of the value at a path."""
    for name, _ in _STEP.findall(path):
        parts = [kind]
        while parts and name and not (dataclasses.is_dataclass(parts[0]) or is_typeddict(parts[0])):
            parts = [*parts[1:], *(each for each in get_args(parts[0]) if not isinstance(each, Meta))]
        if name:
            if parts:
                kind = get_type_hints(parts[0], include_extras=True).get(name)
            else:
                kind = None
        else:
            if get_args(kind):
                kind = get_args(kind)[-1 if get_origin(kind) is dict else 0]
            else:
                kind = None
    return kind

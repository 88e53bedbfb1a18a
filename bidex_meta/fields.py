"""Checks of the numbers and words in a dataclass of settings, by its annotations; imports no torch."""

import dataclasses
import math
import types
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from bidex_meta.errors import BidexError, shortened

MOST = 10**12
"""No count of anything is larger."""
_WIDEST = 65_536
"""Of a network's layer; so wide a one alone holds 17 GB."""
_RATES = "learning_rate"


def check_fields(config: Any, name: str) -> None:
    """Refuses values that are not of their field's type, and numbers that no field can mean.

    A whole number lies in [0, 10^12], another one is finite, what is called a learning rate is above 0; a ``seed`` goes
    up to 2^63 - 1, a width in ``hidden`` from 1 to 65,536. What a field allows beyond that its class says.

    Args:
        config: An instance of a dataclass.
        name: How it calls itself in messages.

    Raises:
        BidexError: Told of the first field that is not so.
    """
    hints = get_type_hints(type(config))
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        told = _unlike(value, hints[field.name], field.name)
        if told is not None:
            raise BidexError(f"{name}: {field.name} must be {told}, got {shortened(value)}.")


def _unlike(value: Any, hint: Any, name: str) -> str | None:
    """What a value should be, where it is not of its annotation; None where it is, or that says too little."""
    if isinstance(hint, types.UnionType) or get_origin(hint) is Union:
        told = [_unlike(value, part, name) for part in get_args(hint) if part is not type(None)]
        fits = None in told or (value is None and type(None) in get_args(hint))
        return None if fits else f"{' or '.join(map(str, told))} (or None)"
    if get_origin(hint) is Literal:
        return None if value in get_args(hint) else f"one of {', '.join(map(str, get_args(hint)))}"
    if get_origin(hint) is tuple:
        return _unlike_tuple(value, get_args(hint), name)
    if hint is bool:
        return None if isinstance(value, bool) else "true or false"
    if hint is int:
        least, most = (1, _WIDEST) if name == "hidden" else (0, 2**63 - 1 if name == "seed" else MOST)
        return None if type(value) is int and least <= value <= most else f"a whole number from {least} to {most}"
    if hint is float:
        number = type(value) in (int, float) and math.isfinite(value)
        if name.endswith(_RATES):
            return None if number and value > 0.0 else "a number above 0"
        return None if number else "a finite number"
    return None


def _unlike_tuple(value: Any, parts: tuple[Any, ...], name: str) -> str | None:
    several = len(parts) == 2 and parts[1] is Ellipsis
    if not isinstance(value, tuple | list) or (not several and len(value) != len(parts)):
        return "a list of values" if several else f"{len(parts)} values"
    hints = [parts[0]] * len(value) if several else parts
    if len(value) > 64:
        return "at most 64 values"
    told = [_unlike(each, hint, name) for each, hint in zip(value, hints, strict=True)]
    wrong = [each for each in told if each is not None]
    return f"values of which each is {wrong[0]}" if wrong else None

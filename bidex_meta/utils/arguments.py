"""Arguments of public functions, checked against the functions' own annotations.

``@checked_arguments`` decorates a function, a constructor or a dataclass. A call with an argument that its annotation
does not allow raises BidexError, with the argument's name, the expected type and the value.
"""

import functools
import inspect
import math
import numbers
import operator
import re
import types
from collections.abc import Callable, Collection, Iterable, Mapping
from itertools import islice
from pathlib import Path
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    Protocol,
    TypeGuard,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from msgspec import Meta

from bidex_meta.errors import BidexError, shortened
from bidex_meta.utils.validation import MOST

Target = TypeVar("Target", bound=Callable[..., object])

_MOST_ELEMENTS = 1000
"""Number of elements of a collection that are checked: enough to find a wrong type."""
_WORDS: dict[object, str] = {
    bool: "True or False",
    int: "a whole number",
    float: "a number",
    str: "a text",
    Path: "a path (pathlib.Path)",
    types.NoneType: "None",
    None: "None",
}


def checked_arguments(target: Target) -> Target:
    """Check the arguments of every call of a function, or of a dataclass, against their annotations.

    ``int`` allows any whole number, including NumPy's. ``float`` allows any real number except NaN. Neither allows True
    or False. A protocol allows any object that has the protocol's attributes. ``Annotated`` adds bounds. Up to 1,000
    elements of a collection are checked. ``Any`` and missing annotations allow everything.
    """
    if isinstance(target, type):
        target.__init__ = checked_arguments(target.__init__)  # type: ignore[misc]
        return target  # type: ignore[return-value]
    signature = inspect.signature(target)
    name = target.__qualname__.rpartition("<locals>.")[2].removesuffix(".__init__")

    @functools.cache
    def hints() -> dict[str, object]:
        # Not at import time, because names may be defined further down.
        return get_type_hints(target, include_extras=True)

    @functools.wraps(target)
    def checked(*arguments: object, **keywords: object) -> object:
        try:
            given = signature.bind(*arguments, **keywords).arguments
        except TypeError:  # Python raises it for missing and unknown arguments
            return target(*arguments, **keywords)
        for argument, value in given.items():
            hint = hints().get(argument, object)
            kind = signature.parameters[argument].kind
            if kind is inspect.Parameter.VAR_KEYWORD:
                continue
            values = value if kind is inspect.Parameter.VAR_POSITIONAL else (value,)
            for given_value in values:
                check_argument(f"{name}: {argument}", given_value, hint)
        return target(*arguments, **keywords)

    return checked  # type: ignore[return-value]


def check_attributes(kind: type, base: type, name: str) -> None:
    """Raise BidexError for the first attribute of a class that does not fit its annotation in ``base``.

    Properties are not checked, because only instances have their values.
    """
    for attribute, hint in get_type_hints(base, include_extras=True).items():
        value = inspect.getattr_static(kind, attribute, None)
        if hasattr(kind, attribute) and not hasattr(type(value), "__get__"):
            check_argument(f"{name}: {attribute}", value, get_args(hint)[0] if get_origin(hint) is ClassVar else hint)


def check_argument(name: str, value: object, hint: object) -> None:
    """Raise BidexError if a value does not fit an annotation; ``name`` begins the message."""
    if _fits(value, hint):
        return
    protocols = [part for part in (hint, *get_args(hint)) if _is_protocol(part)]
    lacking = min((_lacking(value, protocol) for protocol in protocols), key=len, default=[])
    if lacking:
        without = f", which has no {', '.join(lacking[:6])}"
    else:
        without = ""
    raise BidexError(f"{name}: expected {_expected(hint)}, got {shortened(value)}{without}.")


def _fits(value: object, hint: object) -> bool:
    origin = get_origin(hint)
    parts = get_args(hint)
    if hint in (Any, object) or isinstance(hint, TypeVar):
        return True
    if origin is Annotated:
        return _fits(value, parts[0]) and all(_within(value, bound) for bound in parts[1:] if isinstance(bound, Meta))
    if origin in (Union, types.UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is Literal:
        return any(type(value) is type(choice) and value == choice for choice in parts)
    if origin is not None:
        return _fits_generic(value, origin, parts)
    if hint is None:
        return value is None
    if hint is bool:
        return isinstance(value, bool | np.bool_)
    if hint is int:
        return _is_whole(value)
    if hint is float:
        return isinstance(value, numbers.Real) and not isinstance(value, bool) and value == value
    if _is_protocol(hint):
        return not _lacking(value, hint)
    if isinstance(hint, type):
        return isinstance(value, hint)
    return True


def _fits_generic(value: object, origin: type, parts: tuple[object, ...]) -> bool:
    if not isinstance(value, origin):
        return False
    if isinstance(value, str | bytes):
        return False  # a string is a sequence of strings, which nobody means
    if isinstance(value, Mapping):
        pairs = list(islice(value.items(), _MOST_ELEMENTS))
        return len(parts) < 2 or all(_fits(key, parts[0]) and _fits(each, parts[1]) for key, each in pairs)
    if origin is tuple and parts[-1:] != (...,):
        return len(value) == len(parts) and all(map(_fits, value, parts))  # type: ignore[arg-type]
    if isinstance(value, Collection) and parts and issubclass(origin, Iterable):
        return all(_fits(each, parts[0]) for each in islice(value, _MOST_ELEMENTS))
    return True


def _is_whole(value: object) -> bool:
    try:
        operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        return False
    return not isinstance(value, bool | np.bool_)


def _within(value: Any, bound: Meta) -> bool:
    if hasattr(value, "__len__"):
        length = len(value)
    else:
        length = math.inf
    return (
        (bound.ge is None or value >= bound.ge)
        and (bound.gt is None or value > bound.gt)
        and (bound.le is None or value <= bound.le)
        and (bound.lt is None or value < bound.lt)
        and (bound.pattern is None or re.search(bound.pattern, value) is not None)
        and (bound.min_length is None or length >= bound.min_length)
        and (bound.max_length is None or length <= bound.max_length)
    )


def _is_protocol(hint: object) -> TypeGuard[type]:
    return isinstance(hint, type) and getattr(hint, "_is_protocol", False)


def _lacking(value: object, protocol: type) -> list[str]:
    """Return the attributes of a protocol that a value does not have."""
    return [name for name in _members(protocol) if not hasattr(value, name)]


@functools.cache
def _members(protocol: type) -> list[str]:
    names: dict[str, None] = {}
    for base in reversed(protocol.__mro__):
        if base not in (Protocol, object) and getattr(base, "_is_protocol", False):
            own = (*inspect.get_annotations(base), *vars(base))
            names |= dict.fromkeys(name for name in own if not name.startswith("_"))
    return list(names)


def _expected(hint: object) -> str:
    """Describe in words the values that an annotation allows, for error messages."""
    origin = get_origin(hint)
    parts = get_args(hint)
    if origin is Annotated:
        return f"{_expected(parts[0])}{''.join(_bounds(part) for part in parts[1:] if isinstance(part, Meta))}"
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(_expected(part) for part in parts))
    if origin is Literal:
        return f"one of {', '.join(map(repr, parts))}"
    if origin is tuple and parts[-1:] != (...,):
        return f"a tuple of {len(parts)}, each {' or '.join(dict.fromkeys(map(_expected, parts)))}"
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return "a dict"
    if isinstance(origin, type) and issubclass(origin, Iterable) and parts:
        return f"a {'tuple' if origin is tuple else 'list'}, each element {_expected(parts[0])}"
    if hint in _WORDS:
        return _WORDS[hint]
    name = getattr(origin or hint, "__name__", str(hint))
    return f"{'an' if name[0] in 'AEIOU' else 'a'} {name}"


def _bounds(bound: Meta) -> str:
    words = []
    if bound.ge is not None and abs(bound.ge) < MOST:
        words.append(f"from {bound.ge} on")
    if bound.gt is not None:
        words.append(f"above {bound.gt}")
    if bound.le is not None and bound.le < MOST:
        words.append(f"up to {bound.le}")
    if bound.lt is not None:
        words.append(f"below {bound.lt}")
    if bound.ge is None and bound.gt is None and bound.min_length:
        words.append("that is not empty")
    if bound.ge is not None and abs(bound.ge) >= MOST:
        words.append("that is finite")
    return f" {' and '.join(words)}" if words else ""

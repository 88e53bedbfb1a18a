"""Arguments checked against annotations: what fits, and the words of what does not."""

import inspect
import math
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import numpy as np
import pytest
from msgspec import Meta

from bidex_meta.errors import BidexError
from bidex_meta.utils.arguments import check_argument, checked_arguments
from bidex_meta.utils.validation import Count, Finite, Share, Text


class Player(Protocol):
    speed: float

    def play(self) -> None: ...


class Flute:
    speed = 1.0

    def play(self) -> None: ...


@checked_arguments
@dataclass(frozen=True)
class Pair:
    name: Text
    ends: tuple[Finite, Finite] = (0.0, 1.0)


@checked_arguments
def called(number: int, *rest: str, flag: bool = False, **more: int) -> tuple[Any, ...]:
    """Say what it was given."""
    return number, rest, flag, more


@pytest.mark.parametrize(
    ("hint", "good", "bad"),
    [
        (int, [0, -1, np.int8(3), 10**30], [True, 1.0, "1", None, np.array([1, 2]), math.nan]),
        (float, [0, 1.5, np.float32(1), math.inf], [True, "1", None, [1.0], 1j, math.nan]),
        (Finite, [0, 10**30, -1.5], [math.nan, math.inf, -math.inf, 10**400]),
        (bool, [True, np.bool_(False)], [0, 1, None, "yes"]),
        (Text, ["a"], ["", "a\0b", None, b"a", 3]),
        (Count, [1, np.int64(5)], [0, -1, 1.0]),
        (Share, [0.5, 1], [0.0, 1.1]),
        (Path | str | None, [Path("x"), "x", None], [3, [], b"x"]),
        (Literal["a", "b"], ["a"], ["c", None, 1, np.array(["a"])]),
        (tuple[Finite, Finite], [(0, 1)], [[0, 1], (0,), (0, math.nan), "ab"]),
        (Sequence[str], [["a"], ()], ["a", [1], {"a": 1}, 3]),
        (Mapping[str, int], [{}, {"a": 1}], [[], {1: 1}, {"a": "b"}]),
        (Callable[..., Any], [len], [3, "len"]),
        (Player, [Flute()], [3, Flute]),
        (Annotated[Sequence[int], Meta(min_length=1)], [[1]], [[], ["a"]]),
        (Any, [3, None], []),
    ],
)
def test_what_fits_an_annotation(hint: Any, good: list[Any], bad: list[Any]) -> None:
    for value in good:
        check_argument("x", value, hint)
    for value in bad if hint is not Player else bad[:1]:
        with pytest.raises(BidexError, match="x: expected ") as raised:
            check_argument("x", value, hint)
        assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: called("a"), "called: number: expected a whole number, got 'a'."),
        (lambda: called(1, "a", 2), "called: rest: expected a text, got 2."),
        (lambda: called(1, flag=1), "called: flag: expected True or False, got 1."),
        (lambda: Pair(""), "Pair: name: expected a text that is not empty, got ''."),
        (lambda: Pair("a", (0.0, math.nan)), "Pair: ends: expected a tuple of 2, each a number that is finite, got"),
        (lambda: replace(Pair("a"), name=3), "Pair: name: expected a text that is not empty, got 3."),
        (lambda: check_argument("x", 3, Player), "x: expected a Player, got 3, which has no speed, play."),
        (lambda: check_argument("x", 0, Count), "x: expected a whole number from 1 on, got 0."),
        (lambda: check_argument("x", "c", Literal["a", 1]), "x: expected one of 'a', 1, got 'c'."),
    ],
)
def test_the_words_of_an_error(call: Callable[[], Any], told: str) -> None:
    with pytest.raises(BidexError) as raised:
        call()
    assert str(raised.value).startswith(told)


def test_a_checked_function_stays_the_same_function() -> None:
    assert called(1, "a", flag=True, other=2) == (1, ("a",), True, {"other": 2})
    assert called.__doc__ == "Say what it was given." and next(iter(inspect.signature(called).parameters)) == "number"
    assert pickle.loads(pickle.dumps(Pair("a"))) == Pair("a") and pickle.loads(pickle.dumps(called)) is called
    with pytest.raises(TypeError, match="missing 1 required positional argument"):
        called()  # type: ignore[call-arg]
    with pytest.raises(TypeError, match="unexpected keyword"):
        Pair("a", other=3)  # type: ignore[call-arg]

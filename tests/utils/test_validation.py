"""Values from outside are checked by annotations; a complaint names place, expected and received on one line."""

import dataclasses
from typing import Any, Literal

import pytest

from bidex_meta.errors import BidexError
from bidex_meta.utils.validation import Checked, Count, Finite, Fraction, Positive, Widths, check_rising, parse


@dataclasses.dataclass(frozen=True)
class Inner(Checked):
    rate: Positive = 1.0
    count: Count | None = None
    hidden: Widths = (1, 2)
    pair: tuple[Finite, Finite] = (0.0, 1.0)
    kind: Literal["a", "b"] = "a"
    share: Fraction = 0.5
    switch: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        check_rising(self, "inner", "pair")


@dataclasses.dataclass(frozen=True)
class Outer:
    first: Inner = Inner()
    named: dict[str, Inner] = dataclasses.field(default_factory=dict)
    listed: tuple[Inner, ...] = ()


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"rate": float("nan")}, "rate: expected a finite number, got nan"),
    ({"rate": float("inf")}, "rate: expected a finite number, got inf"),
    ({"rate": 0}, "rate: expected a number > 0.0, got 0"),
    ({"count": 1.0}, "count: expected a whole number"),
    ({"count": True}, "count: expected a whole number"),
    ({"count": 0}, "count: expected a whole number >= 1, got 0"),
    ({"hidden": ()}, "hidden: expected a list of length >= 1"),
    ({"hidden": (3, 0)}, r"hidden\[1\]: expected a whole number >= 1, got 0"),
    ({"pair": (2.0, 1.0)}, "pair: expected two rising numbers"),
    ({"pair": (1.0,)}, "pair: expected a list of length 2"),
    ({"kind": "c"}, "kind: expected one of a, b, got 'c'"),
    ({"share": 1.5}, "share: expected a number <= 1.0, got 1.5"),
    ({"switch": 1}, "switch: expected true or false, got 1"),
]


@pytest.mark.parametrize("values, message", WRONG)
def test_a_field_out_of_its_annotation_is_named(values: dict[str, Any], message: str) -> None:
    with pytest.raises(BidexError, match=message):
        Inner(**values)
    content = {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}
    with pytest.raises(BidexError, match=message):
        parse({"first": content}, Outer, "file.toml")


@pytest.mark.parametrize(
    "content, message",
    [
        (3, "content: expected a table, got 3"),
        ({"first": 3}, "first: expected a table, got 3"),
        ({"listed": [{}, {"rate": "fast"}]}, r"listed\[1\].rate: expected a number, got 'fast'"),
        ({"named": {"x": {"kind": "c"}}}, "kind: expected one of a, b"),
        ({"frist": {}}, "frist: unknown entry, did you mean 'first'"),
        ({"named": {"x": {"rates": 1}}}, "named.x.rates: unknown entry, did you mean 'rate'"),
    ],
)
def test_an_entry_of_a_file_is_named_with_its_place(content: object, message: str) -> None:
    with pytest.raises(BidexError, match=f"file.toml: .*{message}"):
        parse(content, Outer, "file.toml", exact=True)


def test_what_is_right_becomes_an_instance() -> None:
    found = parse({"first": {"hidden": [4]}, "listed": [{"kind": "b"}]}, Outer, "file.toml", exact=True)
    assert found == Outer(Inner(hidden=(4,)), {}, (Inner(kind="b"),))

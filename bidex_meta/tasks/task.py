"""A task of a suite, and mappings whose keys are names of task classes."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from bidex_meta.errors import BidexError, shortened
from bidex_meta.rules import V2, Rules, plain_name
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.validation import Text, real_numbers

_NUMBERS = np.dtype("<f8")
Entry = TypeVar("Entry")


class Task(NamedTuple):
    """A task of a suite: a task class together with one variation.

    The variation is a vector of numbers, such as goal coordinates, in which the class's tasks differ. `data` holds
    plain numbers; reading it runs no code. Tasks are equal if their class and variation are equal, even if their
    instructions differ.

    Examples:
        >>> from bidex_meta import Benchmark
        >>> print(Benchmark("MT1-DoorOpenOutward-v2").train_tasks[0].instruction)
        Push both leaves of a double door, the right one to 40 and the left one to 35 degrees
    """

    env_name: str
    """Name of the task class, a key of `train_classes` or `test_classes`; in suites of version 2 `CatchUnderarm-v2`."""
    data: bytes
    """The variation as little-endian float64 numbers, in the order of the class's `variation_space.names`."""
    instruction: str = ""
    """A sentence that says what to do; it leaves out what the suite hides. A task that was made without a benchmark has
    no sentence."""

    @classmethod
    @checked_arguments
    def from_variation(cls, env_name: Text, variation: np.ndarray | Sequence[float], instruction: str = "") -> "Task":
        """Return the task of a class with this variation, shape (size,)."""
        numbers = real_numbers("variation", variation, 1)
        return cls(env_name, numbers.astype(_NUMBERS).tobytes(), instruction)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Task) and self[:2] == other[:2]

    def __ne__(self, other: object) -> bool:
        return not self == other

    def __hash__(self) -> int:
        return hash(self[:2])

    @property
    def variation(self) -> np.ndarray:
        """Return the numbers in `data` as a new array, shape (size,), float64.

        Raises BidexError if `data` is not bytes of float64 numbers.
        """
        try:
            return np.frombuffer(self.data, dtype=_NUMBERS).astype(np.float64)
        except (TypeError, ValueError):
            raise BidexError(
                f"Expected a task's data as bytes of float64 numbers, got {shortened(self.data)}. Take tasks from a "
                "Benchmark, or make one by Task.from_variation."
            ) from None


class ByClass(dict[str, Entry]):
    """A dict whose keys are names of task classes.

    In a suite of version 2 `CatchUnderarm` and `CatchUnderarm-v2` are the same key.
    """

    def __init__(self, entries: Mapping[str, Entry], rules: Rules) -> None:
        super().__init__(entries)
        self._rules = rules

    def _key(self, name: object) -> str:
        if self._rules == V2 and isinstance(name, str):
            for known in self:
                if plain_name(known) == plain_name(name):
                    return known
        raise KeyError(name)

    def __missing__(self, name: str) -> Entry:
        return self[self._key(name)]

    def __contains__(self, name: object) -> bool:
        try:
            return super().__contains__(name) or bool(self._key(name))
        except KeyError:
            return False

    def __or__(self, other: Mapping[str, Entry]) -> "ByClass[Entry]":  # type: ignore[override]
        return ByClass({**self, **other}, self._rules)

    def get(self, name: str, default: Entry | None = None) -> Entry | None:  # type: ignore[override]
        """Return the entry of a name, or the default if there is none."""
        try:
            return self[name]
        except KeyError:
            return default

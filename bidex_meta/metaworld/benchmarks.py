"""Meta-World's constructors of benchmarks: `MT1(env_name, seed)`, `ML20(seed)`, `CustomML(train_envs, test_envs)`.

As in Meta-World, `MT1` and `ML1` take any one class; the suites of these names are `bidex_meta.Benchmark("MT1")` and
`bidex_meta.Benchmark("ML1")`. Classes of version 2, and their tasks, have names such as `CatchUnderarm-v2`. The hands'
bases move, as in every suite. `seed` chooses the tasks (None stands for 0).
"""

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import ClassVar, Literal

from bidex_meta.benchmark import Benchmark
from bidex_meta.errors import BidexError
from bidex_meta.rules import V1, V2, plain_name, versioned_name
from bidex_meta.suite import Split, Suite, SuiteClass
from bidex_meta.tasks import registry
from bidex_meta.utils.arguments import checked_arguments

_ENV_NAMES = [versioned_name(name, rules) for rules, name in product((V1, V2), registry.names())]


class MT1(Benchmark):
    """One class with visible goals and 50 tasks."""

    ENV_NAMES: ClassVar[list[str]] = _ENV_NAMES

    @checked_arguments
    def __init__(self, env_name: str, seed: int | None = None) -> None:
        super().__init__(_suite("MT1", "plain", {"train": [env_name]}), seed or 0)


class ML1(Benchmark):
    """One class with hidden goals, 50 tasks for training and 50 other tasks for testing."""

    ENV_NAMES: ClassVar[list[str]] = _ENV_NAMES

    @checked_arguments
    def __init__(self, env_name: str, seed: int | None = None) -> None:
        super().__init__(_suite("ML1", "masked", {"train": [env_name], "test": [env_name]}), seed or 0)


class CustomMT(Benchmark):
    """Several classes with visible goals and 50 tasks each."""

    @checked_arguments
    def __init__(self, envs: Sequence[str], seed: int | None = None) -> None:
        super().__init__(_suite("CustomMT", "one-hot", {"train": envs}), seed or 0)


class CustomML(Benchmark):
    """Several classes for training and other classes for testing, with hidden goals and 50 tasks each.

    Raises BidexError if a class is in both lists.
    """

    @checked_arguments
    def __init__(self, train_envs: Sequence[str], test_envs: Sequence[str], seed: int | None = None) -> None:
        both = sorted(set(_named(train_envs)) & set(_named(test_envs)))
        if both:
            raise BidexError(f"Expected other classes in test_envs than in train_envs, got {', '.join(both)} in both.")
        super().__init__(_suite("CustomML", "masked", {"train": train_envs, "test": test_envs}), seed or 0)


class _Shipped(Benchmark):
    @checked_arguments
    def __init__(self, seed: int | None = None) -> None:
        super().__init__(type(self).__name__, seed or 0)


class MT4(_Shipped):
    """The suite MT4."""


class MT20(_Shipped):
    """The suite MT20: all classes."""


class ML4(_Shipped):
    """The suite ML4: three training classes, one test class."""


class ML20(_Shipped):
    """The suite ML20: 15 training classes, five test classes."""


def _suite(name: str, observation: Literal["plain", "one-hot", "masked"], classes: dict[Split, Sequence[str]]) -> Suite:
    splits: dict[str, tuple[Split, ...]] = {}
    for split, given in classes.items():
        splits |= {entry: (*splits.get(entry, ()), split) for entry in _named(given)}
    if not all(classes.values()):
        raise BidexError(f"{name}: expected at least one class in each list, got an empty one.")
    versions = {entry != plain_name(entry) for entry in splits}
    if len(versions) > 1:
        raise BidexError(f"{name}: expected classes of one version, got {', '.join(splits)}.")
    if True in versions:
        rules = V2
        full_name = f"{name}-v2"
    else:
        rules = V1
        full_name = name
    splits = {plain_name(entry): where for entry, where in splits.items()}
    kind: Literal["meta", "multi-task"] = "meta" if "test" in classes else "multi-task"
    return Suite(
        name=full_name,
        version=2 if rules == V2 else 1,
        kind=kind,
        description=", ".join(splits),
        observation=observation,
        task_id="class",
        rules=rules,
        base="moving",
        tasks_per_class=50,
        classes=tuple(SuiteClass(entry, entry, where, 1.0, None, (), {}) for entry, where in splits.items()),
        file=Path(f"metaworld.{name}"),
    )


def _named(envs: Sequence[str]) -> list[str]:
    """Return the resolved class names of a list, each once."""
    return list(dict.fromkeys(registry.resolve(name) for name in envs))

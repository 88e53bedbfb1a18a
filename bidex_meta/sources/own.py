"""Our own tasks as sources: a suite by name or TOML path, and a class on its own."""

from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

from bidex_meta.errors import BidexError, unknown_name
from bidex_meta.sources.base import Source
from bidex_meta.suite import Split, load_suite, suite_names
from bidex_meta.tasks import registry

if TYPE_CHECKING:
    from bidex_meta.benchmark import Benchmark
    from bidex_meta.tasks.base import TaskClass

_TASKS_ALONE = 50
"""Tasks that ``make_task_world`` draws for a class on its own."""


class OwnSuite(Source):
    """A suite file, shipped or the user's own."""

    def __init__(self, name: str, config: Mapping[str, Any]) -> None:
        super().__init__(name, config)
        self.suite = load_suite(name)
        self.hides_goals = self.suite.kind == "meta"

    @cached_property
    def benchmark(self) -> "Benchmark":
        """The suite with its classes and the tasks that the config's seed draws."""
        from bidex_meta.benchmark import Benchmark

        return Benchmark(self.name, seed=self.seed)

    def world(self, split: str = "train", rows: int | None = None, mode: str = "DISABLED") -> Any:
        """As in ``Source``."""
        if rows is None:
            # Rows are split evenly over slots, so that all need as many as the slot with the most tasks.
            pools = self.tasks(split).values()
            rows = max(map(len, pools), default=1) * max(len(pools), 1)
        return self.benchmark.make_world(split, rows, self.device, self.seed, mode, self.threads, self.engine)

    def tasks(self, split: str) -> dict[str, list[str]]:
        """As in ``Source``: the names that the file lists, else numbers."""
        pools = {}
        for entry in self.suite.split_classes(cast(Split, split)):
            listed = [task.name for task in entry.tasks if task.split == split]
            pools[entry.name] = listed or [str(number) for number in range(self.suite.tasks_per_class or 0)]
        if self.suite.task_id == "class":
            return pools
        return {f"{name}/{task}": [task] for name, pool in pools.items() for task in pool}

    def task_classes(self) -> "dict[str, TaskClass]":
        """As in ``Source``."""
        return self.benchmark.train_classes


class SingleClass(Source):
    """A class on its own: goal visible, no one-hot, no padding."""

    def __init__(self, name: str, config: Mapping[str, Any]) -> None:
        super().__init__(name, config)
        if name not in registry.names():
            raise unknown_name("task", name, registry.names())
        # None: as the class has it alone.
        self.moving_base: bool | None = {"own": None, "moving": True, "fixed": False}[config.get("base", "own")]

    def world(self, split: str = "train", rows: int | None = None, mode: str = "DISABLED") -> Any:
        """As in ``Source``."""
        from bidex_meta.benchmark import make_task_world

        if split != "train":
            raise BidexError(f"A run on the task {self.name} alone has no {split} split. Leave --split out.")
        return make_task_world(
            self.name,
            rows or _TASKS_ALONE,
            self.device,
            self.seed,
            mode,
            self.threads,
            moving_base=self.moving_base,
            engine=self.engine,
        )

    def tasks(self, split: str) -> dict[str, list[str]]:
        """As in ``Source``."""
        return {self.name: [str(number) for number in range(_TASKS_ALONE)]} if split == "train" else {}

    def task_classes(self) -> "dict[str, TaskClass]":
        """As in ``Source``."""
        return {self.name: registry.get(self.name, self.moving_base)}


def listed() -> list[dict[str, Any]]:
    """A row of ``bidex-meta list suites`` for each suite that this installation ships."""
    suites = [load_suite(name) for name in suite_names()]
    return [
        {
            "name": suite.name,
            "kind": suite.kind,
            "train_classes": [entry.name for entry in suite.split_classes("train")],
            "test_classes": [entry.name for entry in suite.split_classes("test")],
            "summary": suite.description,
        }
        for suite in suites
    ]

"""Worlds of our own classes: those of a suite, or of a single class."""

from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, cast

from bidex_meta.errors import BidexError
from bidex_meta.rules import V1, V2, Rules, plain_name
from bidex_meta.suite import Split, Suite
from bidex_meta.suite_files import load_suite
from bidex_meta.tasks import registry
from bidex_meta.utils.plugins import name_with_object
from bidex_meta.worlds.base import V2_PRESET, Identity, Worlds, WorldsConfig

if TYPE_CHECKING:
    from bidex_meta.worlds.base import PooledWorld, TaskClass

_TASKS_ALONE = 50  # number of tasks that ``make_task_world`` draws for a single class


class OwnSuite(Worlds):
    """The worlds of a suite file, which is shipped or the user's."""

    suite: Suite

    def __init__(self, name: str, config: WorldsConfig) -> None:
        super().__init__(name, config)
        self.suite = load_suite(name).with_train_tasks(config.tasks_per_class)
        if self.points:
            self.suite = replace(self.suite, points=self.points)
        if self.touch:
            self.suite = replace(self.suite, touch=True)
        self.touch = self.suite.touch
        if self.suite.rules.success == "at-end":
            self.preset = V2_PRESET
        self.hides_goals = self.suite.observation == "masked"

    @cached_property
    def benchmark(self):
        """Return the suite with its classes and the tasks that the config's seed draws."""
        from bidex_meta.benchmark import Benchmark

        return Benchmark(self.suite, seed=self.seed)

    def with_new_tasks(self, seed: int) -> "OwnSuite":
        """See ``Worlds``."""
        found = OwnSuite(self._opened_as, replace(self.config, task_seed=seed))
        found.benchmark = self.benchmark.with_new_tasks(seed)
        found.suite = found.benchmark.suite
        return found

    def world(self, split: str = "train", rows: int | None = None, mode: str | None = None) -> "PooledWorld":
        """See ``Worlds``."""
        if rows is None:
            # Environments are split evenly over slots, so all slots need as many as the slot with the most tasks.
            pools = self.tasks(split).values()
            rows = max(map(len, pools), default=1) * max(len(pools), 1)
        # If the config names no file, the suite's own randomisation applies in training (``mode`` is given), but not in
        # evaluations.
        return self.benchmark.make_world(
            split, rows, self.device, self.seed, mode or "DISABLED", self.threads, self.engine,
            randomisation=self.randomisation or mode is not None, deterministic=self.deterministic,
            switches=self.switches,
        )  # fmt: skip

    def tasks(self, split: str) -> dict[str, list[str]]:
        """Return the task names that the file lists, or numbers if it lists none; see ``Worlds``."""
        return self.suite.task_names(cast(Split, split))

    def train_tasks(self) -> dict[str, int]:
        """See ``Worlds``."""
        if self.suite.train_tasks == 0:
            return dict.fromkeys(self.tasks("train"), 0)
        return super().train_tasks()

    def task_classes(self) -> "dict[str, TaskClass]":
        """See ``Worlds``."""
        return self.benchmark.task_classes()

    def all_task_classes(self) -> "dict[str, TaskClass]":
        """See ``Worlds``."""
        return self.benchmark.task_classes("train") | self.benchmark.task_classes("test")

    @property
    def rules(self) -> Rules:
        """Return the suite's rules."""
        return self.suite.rules

    def identity(self) -> Identity:
        """Return the identity of the classes of both splits; see ``Worlds``."""
        return super().identity() | {"suite_version": self.suite.version, "suite_digest": self.suite.digest}


class SingleClass(Worlds):
    """The worlds of a single class, with a visible goal, without one-hot and without padding."""

    class_name: str

    def __init__(self, name: str, config: WorldsConfig) -> None:
        super().__init__(name, config)
        self.moving_base = {"own": None, "moving": True, "fixed": False}[config.base]
        self.class_name = name
        self.object = config.object
        if registry.plain_name(name) != name:
            self.preset = V2_PRESET
        self.name = name_with_object(name, self.object)
        if self.object is not None:
            self.task_classes()  # raises BidexError now for an unknown class

    def world(self, split: str = "train", rows: int | None = None, mode: str | None = None) -> "PooledWorld":
        """See ``Worlds``."""
        from bidex_meta.benchmark import make_task_world

        if split != "train":
            raise BidexError(f"A run on the single task {self.name} has no {split} split. Leave --split out.")
        named = {"moving_base": self.moving_base, "engine": self.engine, "points": self.points, "object": self.object}
        named |= {"randomisation": self.randomisation, "touch": self.touch}
        named |= {"deterministic": self.deterministic, "switches": self.switches}
        given = self.class_name, rows or _TASKS_ALONE, self.device, self.seed, mode or "DISABLED", self.threads
        return make_task_world(*given, **named)

    def tasks(self, split: str) -> dict[str, list[str]]:
        """See ``Worlds``."""
        if split == "train":
            return {self.name: list(map(str, range(_TASKS_ALONE)))}
        return {}

    def task_classes(self) -> "dict[str, TaskClass]":
        """See ``Worlds``."""
        options = registry.with_object(self.object)
        return {self.name: registry.get(self.class_name, self.moving_base, self.touch, **options)}

    @property
    def rules(self) -> Rules:
        """Return the rules of version 2 if the class's name ends in ``-v2``, otherwise those of version 1."""
        if self.class_name == plain_name(self.class_name):
            return V1
        return V2

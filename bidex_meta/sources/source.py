"""What a config names, resolved once: `Source.open(config)`. Who holds a source need not know of which kind it is.

Opening reads a suite file at most; torch and physics are imported when a world is made or judged.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, cast

from bidex_meta.clients.metaworld import SUITES as METAWORLD_SUITES
from bidex_meta.errors import BidexError, known_name
from bidex_meta.outside import name_with_object
from bidex_meta.suite import Split, load_suite, suite_names
from bidex_meta.tasks import registry

if TYPE_CHECKING:
    from bidex_meta.agents import Agent
    from bidex_meta.benchmark import Benchmark
    from bidex_meta.evaluation.references import Reference
    from bidex_meta.evaluation.results import Evaluation
    from bidex_meta.tasks.base import TaskClass
    from bidex_meta.world.contract import PooledWorld

_ROWS_AND_STEPS = {"cpu": (1024, 20_000_000), "gpu": (8192, 200_000_000)}
# Whole episodes of all rows make one meta-batch: with fewer rows there are more of them.
_ADAPTING_ROWS_AND_STEPS = (300, 20_000_000)


class Source(ABC):
    """The worlds that a config names, and what holds for all of them.

    Args:
        name: How the user calls it: a suite's name or path, or a task class.
        config: A run's config, or a part of one; read are ``seed`` (0), ``task_seed`` (None: ``seed``),
            ``device`` (cpu, of this very process), ``threads`` (None: one per core), ``engine`` (auto), ``points`` (0:
            as the suite says) and, by a single class, ``base`` (own) and ``object`` (None: its own).
    """

    hides_goals: bool = False
    """Whether it is a meta suite, whose goals have to be found out."""
    on_gpu: ClassVar[bool] = True
    """Whether a GPU is of use to its worlds."""
    preset: ClassVar[tuple[str, str] | None] = None
    """A preset for such worlds alone, which goes before others where a learner has it; and, in words, why."""
    default_episodes: ClassVar[int] = 4
    """Episodes of each task in an evaluation where nobody says otherwise."""

    def __init__(self, name: str, config: Mapping[str, Any]) -> None:
        self.name = name
        task_seed = config.get("task_seed")
        self.seed: int = config.get("seed", 0) if task_seed is None else task_seed
        self.device: str = config.get("device", "cpu")
        self.threads: int | None = config.get("threads")
        self.engine: str = config.get("engine", "auto")
        self.points: int = config.get("points", 0)

    @staticmethod
    def open(config: Mapping[str, Any]) -> "Source":
        """The source of a run's config: its ``suite``, or without one the class ``task`` on its own, in any case.

        Raises:
            BidexError: Unknown suite or task, with the nearest name; or a faulty suite file.
        """
        from bidex_meta.sources.humanoid_task import HUMANOID, HumanoidTask
        from bidex_meta.sources.metaworld_suite import MetaWorldSuite

        suite = config.get("suite")
        if suite is None and config["task"].casefold() == HUMANOID.casefold():
            return HumanoidTask(HUMANOID, config)
        if suite is None:
            return SingleClass(registry.resolve(config["task"], "task"), config)
        if not suite.endswith(".toml"):
            suite = known_name("suite", suite, source_names())
        return (MetaWorldSuite if suite in METAWORLD_SUITES else OwnSuite)(suite, config)

    @abstractmethod
    def world(self, split: str = "train", rows: int | None = None, mode: str = "DISABLED") -> "PooledWorld":
        """A fresh world of one split.

        Args:
            split: ``train`` or ``test``.
            rows: Rows over all tasks; one per task by default (a few per class where it is Meta-World's).
            mode: Autoreset mode: SAME_STEP to train in, DISABLED to evaluate in.

        Raises:
            BidexError: There is no such split, too few rows, or a device or an engine that it does not run on.
        """

    @abstractmethod
    def tasks(self, split: str) -> dict[str, list[str]]:
        """Names of the tasks in the pool of each slot of a split's worlds, by the slot's name; empty without any."""

    @abstractmethod
    def task_classes(self) -> "dict[str, TaskClass]":
        """The classes of its train split by name.

        Raises:
            BidexError: They are Meta-World's, of which nothing is drawn or measured here.
        """

    def _check_foreign(self, split: str, told: str) -> None:
        """Refuses another split than train, and other engines than C MuJoCo on the CPU; ``told``: whose they are."""
        if split != "train":
            raise BidexError(f"{self.name} has the split train alone, got {split!r}. Leave --split out.")
        if not self.device.startswith("cpu") or self.engine == "warp":
            wrong = "--engine warp" if self.engine == "warp" else f"--device {self.device}"
            raise BidexError(f"{told} on the CPU in C MuJoCo, got {wrong}. Add --device cpu.")

    @property
    def splits(self) -> list[str]:
        """The splits there are: ``train``, and ``test`` for a meta suite."""
        return [split for split in ("train", "test") if self.tasks(split)]

    def rows_and_steps(self, device: str, adapts: bool) -> tuple[int, int]:
        """Rows of a training world, and steps of a run over all of them, where nobody says otherwise.

        Args:
            device: ``cpu``, ``cuda``, ``cuda:0``, ...
            adapts: Whether the learner adapts to tasks.
        """
        if not device.startswith("cpu"):
            return _ROWS_AND_STEPS["gpu"]
        return _ADAPTING_ROWS_AND_STEPS if adapts else _ROWS_AND_STEPS["cpu"]

    @property
    def moving_bases(self) -> bool:
        """Whether the hands move as in the shipped suites, and as where references were measured."""
        return all(task_class.moving_base for task_class in self.task_classes().values())

    def identity(self) -> dict[str, Any]:
        """What tells its worlds from others of the same name, ready for JSON.

        Returns:
            ``physics``: twelve letters of the classes' physics (``bidex_meta.engine.identity``), None where they are
            not ours; ``suite_version``: of the suite's file, None without one.
        """
        return {"physics": _physics(self.task_classes()), "suite_version": None}

    def references(self) -> "dict[str, Reference]":
        """The references of the normalised score and of broken episodes, of which those of other bases are none."""
        from bidex_meta.evaluation.references import references

        return references() if self.moving_bases else {}

    def judge(self, agent: "Agent", world: "PooledWorld", episodes: int | None, seed: int) -> "Evaluation":
        """Evaluate a policy on all tasks of a split, beside the references.

        Args:
            agent: The policy.
            world: What ``world`` made in mode DISABLED.
            episodes: Episodes of each task; None takes ``default_episodes``.
            seed: Of the starts.
        """
        from bidex_meta.evaluation.play import evaluate

        episodes = self.default_episodes if episodes is None else episodes
        return evaluate(agent, world, episodes, seed=seed, references=self.references())


_TASKS_ALONE = 50
"""Tasks that ``make_task_world`` draws for a class on its own."""


class OwnSuite(Source):
    """A suite file, shipped or the user's own."""

    def __init__(self, name: str, config: Mapping[str, Any]) -> None:
        super().__init__(name, config)
        suite = load_suite(name)
        self.suite = replace(suite, points=self.points) if self.points else suite
        self.hides_goals = self.suite.kind == "meta"

    @cached_property
    def benchmark(self) -> "Benchmark":
        """The suite with its classes and the tasks that the config's seed draws."""
        from bidex_meta.benchmark import Benchmark

        return Benchmark(self.suite, seed=self.seed)

    def world(self, split: str = "train", rows: int | None = None, mode: str = "DISABLED") -> "PooledWorld":
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
        return self.benchmark.task_classes()

    def identity(self) -> dict[str, Any]:
        """As in ``Source``; of the classes of both splits."""
        classes = self.benchmark.task_classes("train") | self.benchmark.task_classes("test")
        return {"physics": _physics(classes), "suite_version": self.suite.version}


class SingleClass(Source):
    """A class on its own: goal visible, no one-hot, no padding."""

    def __init__(self, name: str, config: Mapping[str, Any]) -> None:
        super().__init__(name, config)
        # None: as the class has it alone.
        self.moving_base: bool | None = {"own": None, "moving": True, "fixed": False}[config.get("base", "own")]
        self.class_name, self.object = name, config.get("object")
        self.name = name_with_object(name, self.object)
        if self.object is not None:
            self.task_classes()  # says now what is wrong with it

    def world(self, split: str = "train", rows: int | None = None, mode: str = "DISABLED") -> "PooledWorld":
        """As in ``Source``."""
        from bidex_meta.benchmark import make_task_world

        if split != "train":
            raise BidexError(f"A run on the task {self.name} alone has no {split} split. Leave --split out.")
        return make_task_world(
            self.class_name,
            rows or _TASKS_ALONE,
            self.device,
            self.seed,
            mode,
            self.threads,
            moving_base=self.moving_base,
            engine=self.engine,
            points=self.points,
            object=self.object,
        )

    def tasks(self, split: str) -> dict[str, list[str]]:
        """As in ``Source``."""
        return {self.name: [str(number) for number in range(_TASKS_ALONE)]} if split == "train" else {}

    def task_classes(self) -> "dict[str, TaskClass]":
        """As in ``Source``."""
        return {self.name: registry.get(self.class_name, self.moving_base, **registry.with_object(self.object))}


def _physics(classes: "Mapping[str, TaskClass]") -> str:
    from bidex_meta.engine.identity import common_identity
    from bidex_meta.tasks.scene import compile_scene

    return common_identity({name: compile_scene(task_class).model for name, task_class in classes.items()})


def source_names() -> list[str]:
    """Every suite that a config may name: the shipped ones and Meta-World's."""
    return [*suite_names(), *METAWORLD_SUITES]


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

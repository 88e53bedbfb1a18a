"""What a config names, resolved once: `Source.open(config)`. Who holds a source need not know of which kind it is.

Opening reads a suite file at most; torch and physics are imported when a world is made or judged.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from bidex_meta.agents import Agent
    from bidex_meta.evaluation.results import Evaluation
    from bidex_meta.evaluation.scores import Reference
    from bidex_meta.tasks.base import TaskClass

_ROWS_AND_STEPS = {"cpu": (1024, 20_000_000), "gpu": (8192, 200_000_000)}
# Whole episodes of all rows make one meta-batch: with fewer rows there are more of them.
_ADAPTING_ROWS_AND_STEPS = (300, 20_000_000)


class Source(ABC):
    """The worlds that a config names, and what holds for all of them.

    Args:
        name: How the user calls it: a suite's name or path, or a task class.
        config: A run's config, or a part of one; read are ``seed`` (0), ``device`` (cpu, of this very process),
            ``threads`` (None: one per core), ``engine`` (auto) and, by a single class, ``base`` (own).
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
        self.seed: int = config.get("seed", 0)
        self.device: str = config.get("device", "cpu")
        self.threads: int | None = config.get("threads")
        self.engine: str = config.get("engine", "auto")

    @staticmethod
    def open(config: Mapping[str, Any]) -> "Source":
        """The source of a run's config: its ``suite``, or without one the class ``task`` on its own.

        Raises:
            BidexError: Unknown suite or task, with the nearest name; or a faulty suite file.
        """
        from bidex_meta.sources.metaworld_suite import MetaWorldSuite, is_foreign
        from bidex_meta.sources.own import OwnSuite, SingleClass

        suite = config.get("suite")
        if suite is None:
            return SingleClass(config["task"], config)
        return (MetaWorldSuite if is_foreign(suite) else OwnSuite)(suite, config)

    @abstractmethod
    def world(self, split: str = "train", rows: int | None = None, mode: str = "DISABLED") -> Any:
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

    def references(self) -> "dict[str, Reference]":
        """The references of the normalised score and of broken episodes, of which those of other bases are none."""
        from bidex_meta.evaluation.references import references

        return references() if self.moving_bases else {}

    def judge(self, agent: "Agent", world: Any, episodes: int | None, seed: int) -> "Evaluation":
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

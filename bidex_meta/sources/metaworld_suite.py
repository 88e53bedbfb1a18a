"""Meta-World's suites as sources: an environment a row, stepped on the CPU in C MuJoCo."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from bidex_meta.clients.metaworld import SUITES, TASKS_PER_CLASS, class_names
from bidex_meta.errors import BidexError
from bidex_meta.memory import check_memory
from bidex_meta.sources.source import Source

if TYPE_CHECKING:
    from bidex_meta.agents import Agent
    from bidex_meta.evaluation.references import Reference
    from bidex_meta.evaluation.results import Evaluation
    from bidex_meta.tasks.base import TaskClass
    from bidex_meta.world.contract import PooledWorld

# Of each class. A row is an environment of some 10 MB; 2 M steps a class is the budget of published results.
_TRAINING_ROWS, _TRAINING_STEPS = 4, 2_000_000
_ROW_BYTES = 10_000_000
# Its tasks are played in turns, and 5 divides 50.
_EVALUATION_ROWS = 5


class MetaWorldSuite(Source):
    """A suite of Meta-World's, which has the split train alone and neither references nor pictures."""

    on_gpu = False
    preset = ("metaworld", "the suite is Meta-World's")
    default_episodes = 1  # its tasks fix their start, so that a policy would only repeat itself

    def __init__(self, name: str, config: Mapping[str, Any]) -> None:
        super().__init__(name, config)
        self.class_names = class_names(name)
        if self.points:
            raise BidexError(f"Point clouds are made of scenes of our own, got the suite {name}. Leave --points out.")

    def world(self, split: str = "train", rows: int | None = None, mode: str = "DISABLED") -> "PooledWorld":
        """As in ``Source``."""
        self._check_foreign(split, "Meta-World's environments run")
        from bidex_meta.clients.metaworld_world import MetaWorldWorld

        rows = rows or _EVALUATION_ROWS * len(self.class_names)
        check_memory(rows * _ROW_BYTES, f"{rows:,} rows", "Lower --num-envs.")
        return MetaWorldWorld(self.name, rows, seed=self.seed, autoreset_mode=mode)

    def tasks(self, split: str) -> dict[str, list[str]]:
        """As in ``Source``."""
        numbers = [str(number) for number in range(TASKS_PER_CLASS)]
        return dict.fromkeys(self.class_names, numbers) if split == "train" else {}

    def task_classes(self) -> "dict[str, TaskClass]":
        """As in ``Source``: refused."""
        raise BidexError(
            f"Pictures and references are made of classes of our own, got the suite {self.name}. Name another."
        )

    def identity(self) -> dict[str, Any]:
        """As in ``Source``: the physics is Meta-World's, known by its package's version."""
        return {"physics": None, "suite_version": None}

    def rows_and_steps(self, device: str, adapts: bool) -> tuple[int, int]:
        """As in ``Source``."""
        return _TRAINING_ROWS * len(self.class_names), _TRAINING_STEPS * len(self.class_names)

    def references(self) -> "dict[str, Reference]":
        """As in ``Source``: none."""
        return {}

    def judge(self, agent: "Agent", world: "PooledWorld", episodes: int | None, seed: int) -> "Evaluation":
        """As in ``Source``: the fifty tasks of each class a few at a time, as many as the world has rows for."""
        from bidex_meta.clients.metaworld_world import evaluate_all_tasks

        return evaluate_all_tasks(agent, world, self.default_episodes if episodes is None else episodes, seed=seed)


def listed() -> list[dict[str, Any]]:
    """A row of ``bidex-meta list suites`` for each suite of Meta-World's."""
    summary = "Meta-World's own environments, to run our learners on (only run and evaluate know them)"
    return [
        {"name": name, "kind": "multi-task", "train_classes": list(classes), "test_classes": [], "summary": summary}
        for name, classes in SUITES.items()
    ]

"""Worlds of other libraries' environments, on the CPU in C MuJoCo: Meta-World's suites, Gymnasium's humanoid."""

from typing import TYPE_CHECKING

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.eval_protocol import Protocol
from bidex_meta.evaluation.references import Reference
from bidex_meta.evaluation.results import Evaluation
from bidex_meta.suite_files import metaworld_classes
from bidex_meta.utils.memory import check_memory
from bidex_meta.worlds.base import Identity, Worlds, WorldsConfig

if TYPE_CHECKING:
    from bidex_meta.worlds.base import Agent, PooledWorld, TaskClass

HUMANOID = "gymnasium/Humanoid-v5"  # name of the class in ``--task``

# Environments and steps per class of Meta-World; 2 M steps are the budget of published results.
_TRAINING_SIZE = 4
_TRAINING_STEPS = 2_000_000
# Number of tasks of a Meta-World class, and number of tasks that are played at a time.
_TASKS = 50
_EVALUATION_SIZE = 5
_HUMANOIDS = 50


class Foreign(Worlds):
    """Worlds of task classes that come from another library.

    These worlds have only the split ``"train"``, no reference returns and no pictures.
    """

    on_gpu = False
    bytes_per_environment: int

    def __init__(self, name: str, config: WorldsConfig) -> None:
        super().__init__(name, config)
        if self.randomisation is not None:
            raise BidexError(f"Only bidex-meta's own worlds can be randomised, got {name}. Leave --randomisation out.")
        if config.touch:
            raise BidexError(f"Only bidex-meta's hands have touch sensors, got {name}. Leave --touch out.")
        if config.tasks_per_class is not None:
            raise BidexError(f"Only bidex-meta's own suites draw their tasks, got {name}. Leave --tasks-per-class out.")

    def _check(self, split: str, rows: int) -> None:
        """Raise BidexError if the world cannot be made.

        The split must be ``train``, the engine must be C MuJoCo on the CPU, and the environments must fit into memory.
        """
        if split != "train":
            raise BidexError(f"{self.name} has only the split train, got {split!r}. Leave --split out.")
        if not self.device.startswith("cpu") or self.engine == "warp":
            if self.engine == "warp":
                wrong = "--engine warp"
            else:
                wrong = f"--device {self.device}"
            raise BidexError(f"{self.name} runs on the CPU in C MuJoCo, got {wrong}. Add --device cpu.")
        check_memory(rows * self.bytes_per_environment, f"{rows:,} environments", "Lower --num-envs.")

    def task_classes(self) -> "dict[str, TaskClass]":
        """Raise BidexError: the classes belong to another library."""
        raise BidexError(f"Pictures and references need bidex-meta's own classes, got {self.name}. Name another.")

    def identity(self) -> Identity:
        """Return an identity whose entries are None: the version of the library's package identifies the physics."""
        return {"physics": None, "suite_version": None, "suite_digest": None}

    def references(self) -> dict[str, Reference]:
        """Return an empty dict: there are no references for another library's classes."""
        return {}


class MetaWorldSuite(Foreign):
    """The worlds of one of Meta-World's suites."""

    preset = ("metaworld", "the suite is Meta-World's")
    default_episodes = 1  # tasks fix their start, so that further episodes would only repeat the first
    bytes_per_environment = 10_000_000

    def __init__(self, name: str, config: WorldsConfig) -> None:
        super().__init__(name, config)
        self.class_names = metaworld_classes(name)
        if self.points:
            raise BidexError(
                f"Only bidex-meta's own scenes have point clouds, got the suite {name}. Leave --points out."
            )

    def world(self, split: str = "train", rows: int | None = None, mode: str | None = None) -> "PooledWorld":
        """See ``Worlds``."""
        rows = rows or _EVALUATION_SIZE * len(self.class_names)
        self._check(split, rows)
        from bidex_meta.metaworld.batched import MetaWorldWorld

        return MetaWorldWorld(self.name, rows, seed=self.seed, autoreset_mode=mode or "DISABLED")

    def tasks(self, split: str) -> dict[str, list[str]]:
        """See ``Worlds``."""
        if split == "train":
            return {name: list(map(str, range(_TASKS))) for name in self.class_names}
        return {}

    def rows_and_steps(self, device: str, adapts: bool) -> tuple[int, int]:
        """See ``Worlds``."""
        return _TRAINING_SIZE * len(self.class_names), _TRAINING_STEPS * len(self.class_names)

    def evaluate(self, agent: "Agent", world: "PooledWorld", protocol: Protocol) -> Evaluation:
        """Evaluate a policy on the fifty tasks of each class, as ``Worlds.evaluate``.

        The world's environments play as many tasks at a time as there are environments per class.
        """
        from bidex_meta.metaworld.batched import evaluate_all_tasks

        return evaluate_all_tasks(agent, world, protocol.episodes_per_task, seed=protocol.seed)


class HumanoidTask(Foreign):
    """The world of ``worlds/humanoid.py``: a single class with one task."""

    default_episodes = _HUMANOIDS
    class_name = HUMANOID
    bytes_per_environment = 2_000_000

    def __init__(self, name: str, config: WorldsConfig) -> None:
        super().__init__(name, config)
        given = {"points": config.points or None, "object": config.object, "base": config.base.replace("own", "")}
        for flag, value in given.items():
            if value:
                raise BidexError(f"--{flag} is for classes with hands, got {value} with {HUMANOID}. Leave it out.")

    def world(self, split: str = "train", rows: int | None = None, mode: str | None = None) -> "PooledWorld":
        """See ``Worlds``."""
        rows = rows or _HUMANOIDS
        self._check(split, rows)
        from bidex_meta.worlds.humanoid import HumanoidWorld

        return HumanoidWorld(rows, seed=self.seed, autoreset_mode=mode or "DISABLED", threads=self.threads)

    def tasks(self, split: str) -> dict[str, list[str]]:
        """See ``Worlds``."""
        if split == "train":
            return {"Humanoid-v5": ["0"]}
        return {}

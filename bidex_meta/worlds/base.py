"""The interface of all worlds that a config can name; importing it loads neither torch nor physics."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import PurePath
from typing import TYPE_CHECKING, ClassVar, Literal

from bidex_meta.evaluation.eval_protocol import EVALUATION_SEED, Protocol
from bidex_meta.evaluation.references import Reference, references_for
from bidex_meta.evaluation.results import Evaluation
from bidex_meta.rules import Rules
from bidex_meta.suite import OTHER_SEED, Suite
from bidex_meta.suite_files import load_randomisation
from bidex_meta.utils.files import Json

if TYPE_CHECKING:
    from bidex_meta.agents import Agent
    from bidex_meta.tasks.base import TaskClass
    from bidex_meta.world.contract import PooledWorld

Base = Literal["own", "moving", "fixed"]
_SIZES_AND_STEPS = {"cpu": (1024, 20_000_000), "gpu": (8192, 200_000_000)}
# A meta-batch consists of whole episodes of all environments, so fewer environments give more meta-batches.
_ADAPTING_SIZE_AND_STEPS = (300, 20_000_000)


@dataclass(frozen=True)
class WorldsConfig:
    """The worlds of a run, and how they run.

    ``suite`` names a suite, or ``task`` names a single class; ``base`` and ``object`` apply only to a single class.
    """

    suite: str | None = None
    task: str | None = None
    base: Base = "own"
    points: int = 0  # number of points of the cloud that replaces objects' states; 0: as in the suite
    touch: bool = False  # True: observations show touch sensors; False: as in the suite
    object: str | None = None
    tasks_per_class: int | None = None  # train tasks per class of a suite; 0: a new one in each episode or trial
    seed: int = 0  # seed of tasks and starts, unless there is a ``task_seed``
    task_seed: int | None = None  # seed of tasks and starts, in place of ``seed``
    device: str = "cpu"
    threads: int | None = None
    engine: str = "auto"
    deterministic: bool = False  # whether a world on a GPU repeats bit for bit
    switches: str = ""  # changes of the physics that are on trial
    randomisation: str | None = None  # file whose table randomises all worlds; None: training as in the suite

    @staticmethod
    def of(config: "Mapping[str, Json] | WorldsConfig") -> "WorldsConfig":
        """Return the entries of a run's config that concern worlds; the others are left out."""
        if isinstance(config, WorldsConfig):
            return config
        return WorldsConfig(
            **{field.name: config[field.name] for field in fields(WorldsConfig) if field.name in config}
        )


Identity = dict[str, str | int | None]


class Worlds(ABC):
    """The worlds of the suite or class that a config names, and their common properties.

    ``name`` is the name of the suite or class; for a user's own suite it is the path of the file.
    """

    hides_goals: bool = False  # True for a meta suite that hides its goals
    suite: Suite | None = None
    class_name: str | None = None  # name of the class, if the worlds have a single class
    object: str | None = None
    moving_base: bool | None = None  # True if a single class has moving bases; None: as the class defines it
    on_gpu: ClassVar[bool] = True  # True if a GPU speeds these worlds up
    preset: tuple[str, str] | None = None
    """Name of the preset that ``auto`` prefers for these worlds, if the learner has it, and a text with the reason."""
    default_episodes: ClassVar[int] = 4  # default number of episodes per task in an evaluation

    def __init__(self, name: str, config: WorldsConfig) -> None:
        self.name = name
        self._opened_as = name
        self.config = config
        if config.task_seed is None:
            self.seed = config.seed
        else:
            self.seed = config.task_seed
        self.device = config.device
        self.threads = config.threads
        self.engine = config.engine
        self.deterministic = config.deterministic
        self.switches = config.switches
        self.points = config.points
        self.touch = config.touch
        if config.randomisation is None:
            self.randomisation = None
        else:
            self.randomisation = load_randomisation(config.randomisation)

    @abstractmethod
    def world(self, split: str = "train", rows: int | None = None, mode: str | None = None) -> "PooledWorld":
        """Return a fresh world of a split, ``train`` or ``test``.

        ``mode`` is the autoreset mode of a training world; None makes an evaluation world (DISABLED). ``rows`` is the
        number of environments over all tasks, by default one per task (for Meta-World five per class). Raises
        BidexError for a missing split, too few environments, or a device or engine that the world does not support.
        """

    @abstractmethod
    def tasks(self, split: str) -> dict[str, list[str]]:
        """Return, by slot, the names of the tasks in a split's pools; the dict is empty if the split has no tasks."""

    def train_tasks(self) -> dict[str, int]:
        """Return the number of train tasks of each slot; 0 stands for a new task in each episode or trial."""
        return {name: len(tasks) for name, tasks in self.tasks("train").items()}

    @abstractmethod
    def task_classes(self) -> "dict[str, TaskClass]":
        """Return the classes of the train split by name; raises BidexError for classes of another library."""

    def all_task_classes(self) -> "dict[str, TaskClass]":
        """Return the classes of all splits by name; otherwise as ``task_classes``."""
        return self.task_classes()

    @property
    def short_name(self) -> str:
        """Return the name. For a user's own suite file, this is the file's name without folder and suffix."""
        return PurePath(self.name).stem if self.name.endswith(".toml") else self.name

    @property
    def rules(self) -> Rules | None:
        """Return the rules for reward, variation, success and starts, which hold for all classes.

        Return None for classes of another library.
        """
        return None

    @property
    def splits(self) -> list[str]:
        """Return the splits: ``train``, and ``test`` for a meta suite."""
        return [split for split in ("train", "test") if self.tasks(split)]

    @property
    def others(self) -> "Worlds":
        """Return worlds with unseen tasks, drawn with a seed that no run is trained with; see ``with_new_tasks``."""
        return self.with_new_tasks(self.seed + OTHER_SEED)

    def with_new_tasks(self, seed: int) -> "Worlds":
        """Return worlds of the same suite or class with unseen tasks.

        If a suite lists test tasks for its train classes, these are the unseen tasks. Otherwise their number is that of
        the train tasks, and ``seed`` draws them. Raises BidexError if the suite lists all its tasks, and no test tasks.
        """
        return type(self)(self._opened_as, replace(self.config, task_seed=seed))

    def rows_and_steps(self, device: str, adapts: bool) -> tuple[int, int]:
        """Return the default numbers of environments and of environment steps for training.

        ``adapts`` says whether the learner adapts to tasks.
        """
        if not device.startswith("cpu"):
            return _SIZES_AND_STEPS["gpu"]
        if adapts:
            return _ADAPTING_SIZE_AND_STEPS
        return _SIZES_AND_STEPS["cpu"]

    @property
    def moving_bases(self) -> bool:
        """Return whether the hands' bases move in all classes.

        They move in the shipped suites, and they moved when the references were measured.
        """
        return all(task_class.moving_base for task_class in self.task_classes().values())

    def identity(self) -> Identity:
        """Return entries, ready for JSON, that distinguish these worlds from others of the same name.

        ``physics`` is a digest of the classes' physics (``bidex_meta.engine.models``), or None for classes of another
        library. ``suite_version`` and ``suite_digest`` come from the suite's file; they are None without one.
        """
        return {"physics": physics_of(self.all_task_classes()), "suite_version": None, "suite_digest": None}

    def references(self) -> dict[str, Reference]:
        """Return the references of the classes, by name; classes without any are left out.

        References define the score, and the return that an episode with broken physics gets. Stored returns do not
        apply if bases, tasks or reward differ from those with which they were measured.
        """
        return references_for(self.all_task_classes())

    def protocol(self, split: str, episodes: int | None = None, seed: int = EVALUATION_SEED) -> Protocol:
        """Return the protocol of an evaluation with ``episodes`` (None: ``default_episodes``) per task of a split."""
        return Protocol(split, seed, episodes_per_task=self.default_episodes if episodes is None else episodes)

    def evaluate(self, agent: "Agent", world: "PooledWorld", protocol: Protocol) -> Evaluation:
        """Evaluate a policy on all tasks of a world (mode DISABLED)."""
        from bidex_meta.evaluation.play import evaluate

        return evaluate(agent, world, protocol=protocol, references=self.references())


V2_PRESET = "v2", "success counts at the end of the episodes, as in version 2"


def physics_of(classes: "Mapping[str, TaskClass]") -> str:
    """Return a digest of the physics of classes: twelve hexadecimal digits.

    Touch sensors do not change the digest.
    """
    from bidex_meta.engine.models import common_identity
    from bidex_meta.tasks.scene import compile_without_touch

    return common_identity({name: compile_without_touch(task_class) for name, task_class in classes.items()})

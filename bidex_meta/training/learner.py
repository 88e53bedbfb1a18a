"""Interface of a learner to the commands and to the training loop."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum, auto
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from bidex_meta.errors import BidexError
from bidex_meta.utils.validation import Checked

if TYPE_CHECKING:
    import torch

    from bidex_meta.agents import Agent
    from bidex_meta.world.contract import VectorWorld

AutoresetMode = Literal["SAME_STEP", "DISABLED"]
State = dict[str, Any]
"""A part of a checkpoint: tensors, numbers, texts, None, and dicts and lists of these."""
Parts = dict[str, Any]
"""Contents of a checkpoint by name: modules, optimisers, generators, tensors, and dicts and lists of these."""


@dataclass(frozen=True)
class LearnerConfig(Checked):
    """Base class of learners' configs. Fields are checked against their annotations; --help shows their docstrings."""

    @property
    def algo(self) -> str:
        """Return the learner's name for messages, from the class's name: ``ppo`` for ``PPOConfig``."""
        return type(self).__name__.removesuffix("Config").lower()

    def bytes_held(self, num_envs: int, width: int) -> int:
        """Estimate the memory, in bytes, of a learner that stores ``width`` numbers per step of an environment."""
        return 0

    def bytes_stored(self, num_envs: int, width: int) -> int:
        """Return the maximum size, in bytes, of the experience that a checkpoint stores, such as a replay buffer.

        Arguments are as in ``bytes_held``.
        """
        return 0

    def check_environments(self, num_envs: int, tasks: Mapping[str, int]) -> None:
        """Raise BidexError if the learner needs more environments, or other numbers of train tasks.

        ``num_envs`` environments are split evenly over the classes. ``tasks`` are the numbers of train tasks by class;
        0 stands for new tasks in each episode or trial. A sweep checks all its runs before the first one begins.
        """

    @staticmethod
    def environments_of(num_envs: int, classes: Iterable[str]) -> dict[str, int]:
        """Return the number of environments of each class; the first classes take the remainder."""
        names = list(classes)
        share = num_envs // len(names)
        rest = num_envs % len(names)
        return {name: share + (place < rest) for place, name in enumerate(names)}


@dataclass(frozen=True)
class Sources:
    """Sources from which a learner learns in addition to its own experience; None means no such source."""

    data: Any = None
    """Transitions of data sets (``bidex_meta.data.joined.Joined``), for offline learners."""
    demonstrations: Any = None
    """Transitions (``Joined``) that the learner imitates while it also learns from its own experience."""
    teachers: Any = None
    """Policies (``bidex_meta.witness.teachers.Teachers``) that label the states that the learner visits."""

    def check(self, learner: str, *taken: str, needed: str | None = None) -> None:
        """Raise BidexError if there is a source that is not among ``taken``, or if the ``needed`` source is missing."""
        for name, value in vars(self).items():
            if value is not None and name not in taken:
                raise BidexError(f"{learner}: does not learn from {name}. Leave them out of its sources.")
        if needed is not None and getattr(self, needed) is None:
            raise BidexError(f"{learner}: has no {needed} to learn from. Pass sources=Sources({needed}=...).")


NO_SOURCES = Sources()


class Capability(StrEnum):
    """A capability of a learner's class, on which the commands and the training loop rely."""

    ADAPTS = auto()
    """The learner's policy adapts to tasks: ``load_policy`` returns a :class:`bidex_meta.agents.MetaLearningAgent`. The
    agent explores with its own generator, which every call of ``load_policy`` seeds equally. The meta-test reads two
    fields of the learner's config, if present: ``max_adapt_steps`` (the longest episode of adaptation) and
    ``tasks_per_class`` (tasks of each class in a meta-batch)."""
    ADAPTS_INDEPENDENTLY = auto()
    """Each environment adapts only from its own episodes, even if several environments play the same task."""
    OFFLINE = auto()
    """The learner learns from data sets (``Sources.data``) and never steps the world."""
    IMITATES = auto()
    """The learner can use demonstrations and teachers (``Sources``) in addition to its own experience."""
    TAUGHT = auto()
    """The learner learns only from teachers (``Sources.teachers``): it acts, and they label the states that it
    visits."""
    DISCOUNTS_BY_CLASS = auto()
    """The learner uses a separate discount for each class, if the world has them (``world.gammas``)."""


class Learner(ABC):
    """Base of all learners, which train on a world in the mode that :meth:`autoreset_mode` returns.

    ``config`` is an instance of the dataclass of the learner's presets. ``seed`` seeds everything random, including the
    world's first reset. Learners with capability ``OFFLINE``, ``IMITATES`` or ``TAUGHT`` take a fourth argument,
    ``sources``.
    """

    name: ClassVar[str] = "learner"
    """The learner's name in messages."""
    presets: ClassVar[Mapping[str, Any]] = {}
    """Configs by name, all of one dataclass. A run with the preset ``auto`` uses ``laptop`` on a CPU and ``paper`` on a
    GPU; without these two it uses the first preset."""
    task_presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """Presets for learning a single task class, by class; they replace the presets of the same name in ``presets``."""
    capabilities: ClassVar[frozenset[Capability]] = frozenset()
    """Capabilities that commands and training rely on."""
    privileges: ClassVar[tuple[str, ...]] = ()
    """Information, in words, that a learner that adapts has in training besides the rewards of its own episodes."""
    per_process: tuple[str, ...] = ()
    """Entries of ``state_dict`` that differ from process to process; the others are equal in all."""
    environments_per_class: int | None = None
    """Default number of environments of each class on a CPU; None: the default of the suite."""
    env_steps: int
    """Environment steps so far, over all environments of all processes; for offline learners, updates so far."""

    @abstractmethod
    def __init__(self, world: "VectorWorld", config: Any, seed: int):
        pass

    @classmethod
    def autoreset_mode(cls, config: Any) -> AutoresetMode:
        """Return the autoreset mode of the world that the learner trains on."""
        return "SAME_STEP"

    @classmethod
    def bytes_held(cls, config: Any, num_envs: int, width: int) -> int:
        """Estimate the memory of the learner, bytes; see :meth:`LearnerConfig.bytes_held`."""
        if isinstance(config, LearnerConfig):
            return config.bytes_held(num_envs, width)
        return 0

    @classmethod
    def bytes_stored(cls, config: Any, num_envs: int, width: int) -> int:
        """Return the maximum size, in bytes, of the experience that a checkpoint stores, such as a replay buffer.

        See :meth:`LearnerConfig.bytes_stored`.
        """
        if isinstance(config, LearnerConfig):
            return config.bytes_stored(num_envs, width)
        return 0

    @abstractmethod
    def iterate(self) -> dict[str, float]:
        """Collect experience and learn from it; return metrics by tag (``docs/metrics.md``)."""

    @abstractmethod
    def state_dict(self) -> State:
        """Return the learner's part of a checkpoint: everything that a resumed run needs except the world's state.

        Its entry ``policy`` is the result of :meth:`policy_state_dict`.
        """

    @abstractmethod
    def load_state_dict(self, state: State) -> None:
        """Restore the result of :meth:`state_dict`."""

    @abstractmethod
    def policy_state_dict(self) -> State:
        """Return the policy, for :meth:`load_policy`."""

    @classmethod
    @abstractmethod
    def load_policy(cls, state: State, device: "str | torch.device" = "cpu") -> "Agent":
        """Return an agent that plays the policy ``state``, in any number of environments.

        ``state`` is the result of :meth:`policy_state_dict`, which checkpoints hold under ``learner`` and ``policy``.
        """

    def start_from(self, policy: State) -> None:
        """Start from the policy of another run's checkpoint instead of fresh weights."""
        raise BidexError(f"{self.name}: cannot start from another run's policy. Leave --start-from out.")

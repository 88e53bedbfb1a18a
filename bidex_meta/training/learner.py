"""Interface of a learner to the commands and to the training loop."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
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
"""What goes into a checkpoint, by name: modules, optimisers, generators, tensors, and dicts and lists of these."""


@dataclass(frozen=True)
class LearnerConfig(Checked):
    """Base of the learners' configs: fields are checked by their annotations, their docstrings are the flags' help."""

    @property
    def algo(self) -> str:
        """Return the learner's name for messages, from the class's name: ``ppo`` for ``PPOConfig``."""
        return type(self).__name__.removesuffix("Config").lower()

    def bytes_held(self, num_envs: int, width: int) -> int:
        """Estimate the memory, in bytes, of a learner that stores ``width`` numbers per step of an environment."""
        return 0

    def bytes_stored(self, num_envs: int, width: int) -> int:
        """Return the maximum bytes of experience (such as a replay) in a checkpoint; arguments as in ``bytes_held``."""
        return 0


@dataclass(frozen=True)
class Sources:
    """Sources from which a learner learns in addition to its own experience; None means no such source."""

    data: Any = None
    """Transitions of data sets (``bidex_meta.data.joined.Joined``), for offline learners."""
    demonstrations: Any = None
    """Transitions to imitate (``Joined``) while learning by playing."""
    teachers: Any = None
    """Policies (``bidex_meta.witness.teachers.Teachers``) that label the states that the learner visits."""

    def check(self, learner: str, *taken: str, needed: str | None = None) -> None:
        """Raise BidexError for a source that is not ``taken``, or if the ``needed`` one is missing."""
        for name, value in vars(self).items():
            if value is not None and name not in taken:
                raise BidexError(f"{learner}: does not learn from {name}. Leave them out of its sources.")
        if needed is not None and getattr(self, needed) is None:
            raise BidexError(f"{learner}: has no {needed} to learn from. Pass sources=Sources({needed}=...).")


NO_SOURCES = Sources()


class Capability(StrEnum):
    """A capability of a learner's class, which the commands and the training rely on."""

    ADAPTS = auto()
    """Its policy adapts to tasks: ``load_policy`` returns a :class:`bidex_meta.agents.MetaLearningAgent`, which
    explores by its own generator, seeded equally by each call. The meta-test reads ``max_adapt_steps`` (longest episode
    of adaptation) and ``tasks_per_class`` (tasks of a meta-batch) of its config, if there."""
    ADAPTS_INDEPENDENTLY = auto()
    """Each environment adapts only from its own episodes, even if several environments play the same task."""
    OFFLINE = auto()
    """It learns from data sets (``Sources.data``) and never steps the world."""
    IMITATES = auto()
    """It may take demonstrations and teachers while it learns by playing (``Sources``)."""
    TAUGHT = auto()
    """It learns only from teachers (``Sources.teachers``): it plays, and they label the states that it visits."""
    DISCOUNTS_BY_CLASS = auto()
    """It learns with a discount per class, if the world has these (``world.gammas``)."""


class Learner(ABC):
    """Base of all learners, which train on a world in the mode that :meth:`autoreset_mode` returns.

    ``config`` is an instance of the dataclass of its presets. ``seed`` seeds everything random, including the world's
    first reset. Learners with capability ``OFFLINE``, ``IMITATES`` or ``TAUGHT`` take a fourth argument, ``sources``.
    """

    name: ClassVar[str] = "learner"
    """The learner's name in messages."""
    presets: ClassVar[Mapping[str, Any]] = {}
    """Configs by name, all of one dataclass. ``auto``: ``laptop`` on a CPU, ``paper`` on a GPU, else the first."""
    task_presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """Presets for learning a single task class, by class; they replace presets of the same name."""
    capabilities: ClassVar[frozenset[Capability]] = frozenset()
    """Capabilities that commands and training rely on."""
    privileges: ClassVar[tuple[str, ...]] = ()
    """Information, in words, that a learner that adapts has in training besides the rewards of its own episodes."""
    per_process: tuple[str, ...] = ()
    """Entries of ``state_dict`` that differ from process to process; the others are equal in all."""
    environments_per_class: int | None = None
    """Default number of environments of each class on a CPU; None: the default of the suite."""
    env_steps: int
    """Environment steps so far, over all environments of all processes; offline: updates."""

    @abstractmethod
    def __init__(self, world: "VectorWorld", config: Any, seed: int):
        pass

    @classmethod
    def autoreset_mode(cls, config: Any) -> AutoresetMode:
        """Return the autoreset mode of the world that the learner trains on."""
        return "SAME_STEP"

    @classmethod
    def bytes_held(cls, config: Any, num_envs: int, width: int) -> int:
        """Estimate the memory; see :meth:`LearnerConfig.bytes_held`."""
        if isinstance(config, LearnerConfig):
            return config.bytes_held(num_envs, width)
        return 0

    @classmethod
    def bytes_stored(cls, config: Any, num_envs: int, width: int) -> int:
        """Return the most bytes of experience in a checkpoint; see :meth:`LearnerConfig.bytes_stored`."""
        if isinstance(config, LearnerConfig):
            return config.bytes_stored(num_envs, width)
        return 0

    @abstractmethod
    def iterate(self) -> dict[str, float]:
        """Collect experience and learn from it; return metrics by tag (``docs/metrics.md``)."""

    @abstractmethod
    def state_dict(self) -> State:
        """Return all that a resumed run needs besides the world's state; ``policy`` is :meth:`policy_state_dict`."""

    @abstractmethod
    def load_state_dict(self, state: State) -> None:
        """Restore the result of :meth:`state_dict`."""

    @abstractmethod
    def policy_state_dict(self) -> State:
        """Return the policy, for :meth:`load_policy`."""

    @classmethod
    @abstractmethod
    def load_policy(cls, state: State, device: "str | torch.device" = "cpu") -> "Agent":
        """Return the agent of a checkpoint's entry ``learner.policy``, for a world of any number of environments."""

    def start_from(self, policy: State) -> None:
        """Start from the policy of another run's checkpoint instead of fresh weights."""
        raise BidexError(f"{self.name}: cannot start from another run's policy. Leave --start-from out.")

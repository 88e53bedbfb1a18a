"""What can be set about every offline learner; imports no torch, so that a command line can show it at once."""

from dataclasses import dataclass
from typing import Any, ClassVar

from bidex_algos.checks import at_least, between, network_bytes, positive, types, widths
from bidex_algos.choices import Activation, Autocast
from bidex_algos.nets.multitask.config import ArchitectureConfig
from bidex_meta.errors import BidexError


@dataclass(frozen=True)
class OfflineConfig(ArchitectureConfig):
    """Networks, batches, statistics; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "offline"
    """How the learner calls itself in messages."""

    hidden: tuple[int, ...] = (256, 256)
    """Widths of the hidden layers, of actor and critics alike."""
    activation: Activation = "relu"
    """Non-linearity of the hidden layers."""
    policy_heads: bool = False
    """Give the actor an output layer per task; the world must show the task's one-hot."""
    task_embedding: int = 0
    """Size of a learned vector that each network reads in the place of the task's one-hot; 0: the one-hot itself."""
    point_widths: tuple[int, ...] = (32, 64)
    """Widths of the layers that all points of a point cloud share (PointNet), where the data show one."""
    points_read: int = 0
    """Points of a cloud that they read, evenly out of all; 0: all."""
    updates_per_iteration: int = 1000
    """Updates between two reports; --evaluate-every and --video-every count reports."""
    batch_size: int = 256
    """Transitions of an update, split evenly over the tasks."""
    batch_per_task: int | None = None
    """Take this many of each task instead."""
    learning_rate: float = 3e-4
    """Adam's step size for the actor."""
    adam_eps: float = 1e-8
    """What Adam adds to its denominators."""
    max_grad_norm: float | None = None
    """Gradients longer than this are shortened to it, those of each network apart; None: none is."""
    normalise_observations: bool = True
    """Give observations zero mean and unit variance by the data's statistics; the task's one-hot stays as it is."""
    normalise_per_task: bool = False
    """By the statistics of each task's data apart; the world must show the task's one-hot."""
    autocast: Autocast = "auto"
    """Hidden layers in bfloat16; auto: on CUDA and on CPUs with AMX."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        types(self)
        self._check_architecture()
        at_least(self, 1, "updates_per_iteration", "batch_size")
        if self.batch_per_task is not None:
            at_least(self, 1, "batch_per_task")
        at_least(self, 0, "task_embedding", "points_read")
        widths(self, "point_widths")
        positive(self, "learning_rate", *["max_grad_norm"] * (self.max_grad_norm is not None))

    def bytes_held(self, rows: int, width: int) -> int:
        """About how much memory the networks take; the data are counted when they are read.

        Args:
            rows: Rows of its world.
            width: Numbers of a transition.
        """
        return network_bytes(self.hidden, width, 4)


@dataclass(frozen=True)
class CriticConfig(OfflineConfig):
    """What learners with critics add."""

    value_heads: bool = True
    """Give each critic one output per task instead of one for all."""
    critic_layer_norm: bool = True
    """Normalise the hidden layers of the critics, which keeps values of actions that no data show from growing."""
    critic_learning_rate: float = 3e-4
    """Adam's step size for the critics."""
    gamma: float = 0.99
    """Discount per step."""
    tau: float = 0.005
    """Share of the networks that enters their targets in each update (1 - Polyak's factor)."""
    per_task_rewards: bool = True
    """Divide rewards by the standard deviation of their task's discounted returns in the data."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        super().__post_init__()
        if not 0.0 <= self.gamma < 1.0:
            raise BidexError(f"{self.algo}: gamma must lie in [0, 1), got {self.gamma}.")
        between(self, 0.0, 1.0, "tau")
        positive(self, "tau", "critic_learning_rate")


PAPER: dict[str, Any] = {"value_heads": False, "critic_layer_norm": False, "per_task_rewards": False}
"""What the preset ``paper`` leaves out of all learners with critics: Table 46 and the methods' papers know none."""

"""What can be set about every off-policy learner; imports no torch, so that a command line can show it at once."""

from dataclasses import dataclass
from typing import ClassVar

from bidex_algos.checks import at_least, between, network_bytes, positive, types, widths
from bidex_algos.choices import Activation, Autocast
from bidex_algos.nets.multitask.config import ArchitectureConfig
from bidex_meta.errors import BidexError


@dataclass(frozen=True)
class OffPolicyConfig(ArchitectureConfig):
    """Networks, replay, updates, statistics; the defaults are the preset ``laptop``.

    A vector step is one step in every row of the world.
    """

    algo: ClassVar[str] = "off-policy"
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
    """Widths of the layers that all points of a point cloud share (PointNet), where the world shows one."""
    points_read: int = 0
    """Points of a cloud that they read, evenly out of all; 0: all."""
    value_heads: bool = True
    """Give each critic one output per task instead of one for all."""
    critic_layer_norm: bool = True
    """Normalise the hidden layers of the critics, which keeps many updates per step from blowing values up."""
    replay_steps: int = 500
    """Vector steps that the replay keeps, if replay_memory allows."""
    replay_memory: float = 2.0
    """The most that the replay of each process may take, in GB (10^9 bytes)."""
    cut_share: float = 0.0625
    """Room in it for last observations before time limits, as a share of all transitions. Too small where episodes are
    shorter than 1 / cut_share; Train/weightless shows it."""
    warmup_steps: int = 20
    """Vector steps of uniform actions before the first update."""
    steps_per_iteration: int = 8
    """Vector steps between two reports."""
    updates_per_step: int = 4
    """Updates of all networks after each vector step."""
    batch_size: int = 1024
    """Transitions of an update, split evenly over the tasks."""
    batch_per_task: int | None = None
    """Take this many of each task instead."""
    gamma: float = 0.93
    """Discount per step."""
    n_steps: int = 1
    """Steps whose rewards a target takes as they came, before it asks for the value of what follows."""
    tau: float = 0.02
    """Share of the critics that enters the target critics in each update (1 - Polyak's factor)."""
    learning_rate: float = 3e-4
    """Adam's step size for the actor."""
    critic_learning_rate: float = 1e-3
    """Adam's step size for the critics."""
    weight_decay: float = 0.0
    """Share of its step size by which each step shortens all weights of actor and critics (AdamW)."""
    adam_eps: float = 1e-8
    """What Adam adds to its denominators."""
    max_grad_norm: float = 1.0
    """Gradients longer than this are shortened to it, those of actor and critics apart."""
    normalise_observations: bool = True
    """Give observations zero mean and unit variance by running statistics; the task's one-hot stays as it is."""
    per_task_rewards: bool = True
    """Divide rewards, when they are drawn, by the running standard deviation of their task's discounted return."""
    autocast: Autocast = "auto"
    """Hidden layers in bfloat16; auto: on CUDA and on CPUs with AMX or AVX-512's BF16."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        types(self)
        self._check_architecture()
        at_least(self, 1, "replay_steps", "steps_per_iteration", "updates_per_step", "batch_size", "n_steps")
        if self.batch_per_task is not None:
            at_least(self, 1, "batch_per_task")
        at_least(self, 0, "warmup_steps", "task_embedding", "points_read", "weight_decay")
        widths(self, "point_widths")
        if not 0.0 <= self.gamma < 1.0:
            raise BidexError(f"{self.algo}: gamma must lie in [0, 1), got {self.gamma}.")
        between(self, 0.0, 1.0, "tau", "cut_share")
        positive(self, "tau", "cut_share", "replay_memory", "max_grad_norm")

    def bytes_held(self, rows: int, width: int) -> int:
        """About how much memory a learner takes on so many rows.

        Args:
            rows: Rows of its world.
            width: Numbers that are kept of a step of a row.
        """
        replay = min(self.replay_memory * 1e9, 4 * rows * width * self.replay_steps)
        return int(replay) + network_bytes(self.hidden, width, 3)

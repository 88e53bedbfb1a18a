"""What can be set about every on-policy learner; imports no torch, so that a command line can show it at once."""

from dataclasses import dataclass
from typing import Any, ClassVar

from bidex_algos.checks import at_least, between, network_bytes, positive, rising, types, widths
from bidex_algos.choices import Activation, Autocast
from bidex_algos.nets.multitask.config import ArchitectureConfig


@dataclass(frozen=True)
class OnPolicyConfig(ArchitectureConfig):
    """Networks, rollouts, statistics; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "on-policy"
    """How the learner calls itself in messages."""

    hidden: tuple[int, ...] = (256, 256, 128)
    """Widths of the hidden layers, of actor and critic alike."""
    activation: Activation = "elu"
    """Non-linearity of the hidden layers."""
    value_heads: bool = True
    """Give the critic one output per task instead of one for all."""
    policy_heads: bool = False
    """Give the actor an output layer and standard deviations per task instead of one for all; for MT suites, whose
    observations show the task."""
    task_embedding: int = 0
    """Size of a learned vector that each network reads in the place of the task's one-hot; 0: the one-hot itself."""
    point_widths: tuple[int, ...] = (32, 64)
    """Widths of the layers that all points of a point cloud share (PointNet), where the world shows one."""
    points_read: int = 0
    """Points of a cloud that they read, evenly out of all; 0: all."""
    init_std: float = 0.8
    """Standard deviation of the actions at the start."""
    std_range: tuple[float, float] = (0.05, 1.5)
    """Bounds of the standard deviation of the actions."""
    rollout_steps: int = 8
    """Steps taken in every row between two updates."""
    gamma: float = 0.93
    """Discount per step."""
    lam: float = 0.95
    """Trace decay of the advantage estimate."""
    normalise_observations: bool = True
    """Give observations zero mean and unit variance by running statistics; the task's one-hot stays as it is."""
    per_task_values: bool = True
    """Let the critic predict returns normalised per task by running statistics."""
    value_horizon: float = 100.0
    """Iterations after which returns fade from those statistics."""
    per_task_advantages: bool = True
    """Normalise advantages within each task instead of over the whole batch."""
    autocast: Autocast = "auto"
    """Hidden layers in bfloat16; auto: on CUDA and on CPUs with AMX or AVX-512's BF16."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        types(self)
        self._check_architecture()
        at_least(self, 1, "rollout_steps")
        at_least(self, 0, "task_embedding", "points_read")
        widths(self, "point_widths")
        between(self, 0.0, 1.0, "gamma", "lam")
        rising(self, "std_range")
        positive(self, "init_std", "value_horizon")

    def bytes_held(self, rows: int, width: int) -> int:
        """About how much memory a learner takes on so many rows.

        Args:
            rows: Rows of its world.
            width: Numbers that are kept of a step of a row.
        """
        return 4 * rows * width * self.rollout_steps + network_bytes(self.hidden, width, 2)


TABLE_47: dict[str, Any] = {
    "hidden": (2048, 1024, 512),
    "value_heads": False,
    "init_std": 0.8,
    "rollout_steps": 8,
    "num_minibatches": 4,
    "gamma": 0.96,
    "lam": 0.95,
    "max_grad_norm": 1.0,
    "normalise_observations": False,
}
"""Networks, rollouts and returns of MT-PPO in the Bi-DexHands appendix."""

"""What can be set about MT-SAC, and its presets; imports no torch, so that a command line can show it at once."""

from dataclasses import dataclass
from typing import ClassVar

from bidex_algos.checks import at_least, between, positive
from bidex_algos.choices import Activation, Autocast
from bidex_meta.errors import BidexError


@dataclass(frozen=True)
class MTSACConfig:
    """Everything that can be set about MT-SAC; the defaults are the preset ``laptop``.

    A vector step is one step in every row of the world.
    """

    algo: ClassVar[str] = "mtsac"
    """How the learner calls itself in messages."""

    hidden: tuple[int, ...] = (256, 256)
    """Widths of the hidden layers, of actor and critics alike."""
    activation: Activation = "relu"
    """Non-linearity of the hidden layers."""
    policy_heads: bool = False
    """Give the actor an output layer per task; the world must show the task's one-hot."""
    value_heads: bool = True
    """Give each critic one output per task instead of one for all."""
    critic_layer_norm: bool = True
    """Normalise the hidden layers of the critics, which keeps many updates per step from blowing values up."""
    init_std: float = 0.5
    """Standard deviation at the start, before the squashing."""
    std_range: tuple[float, float] = (0.02, 2.0)
    """Its bounds."""
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
    tau: float = 0.02
    """Share of the critics that enters the target critics in each update (1 - Polyak's factor)."""
    learning_rate: float = 3e-4
    """Adam's step size for the actor."""
    critic_learning_rate: float = 1e-3
    """Adam's step size for the critics."""
    alpha_learning_rate: float = 3e-3
    """Adam's step size for the logarithms of the temperatures."""
    adam_eps: float = 1e-8
    """What Adam adds to its denominators."""
    init_alpha: float = 0.001
    """Temperature of every task at the start."""
    target_entropy_per_action: float = -1.0
    """Entropy of the squashed policy that each temperature aims at, for each action; uniform actions have 0.69."""
    max_grad_norm: float = 1.0
    """Gradients longer than this are shortened to it, those of actor and critics apart."""
    normalise_observations: bool = True
    """Give observations zero mean and unit variance by running statistics; the task's one-hot stays as it is."""
    per_task_rewards: bool = True
    """Divide rewards, when they are drawn, by the running standard deviation of their task's discounted return."""
    autocast: Autocast = "auto"
    """Hidden layers in bfloat16; auto: on CUDA and on CPUs with AMX."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        at_least(self, 1, "replay_steps", "steps_per_iteration", "updates_per_step", "batch_size")
        if self.batch_per_task is not None:
            at_least(self, 1, "batch_per_task")
        at_least(self, 0, "warmup_steps")
        if not 0.0 <= self.gamma < 1.0:
            raise BidexError(f"mtsac: gamma must lie in [0, 1), got {self.gamma}.")
        between(self, 0.0, 1.0, "tau", "cut_share")
        positive(self, "tau", "cut_share", "init_alpha", "replay_memory", "max_grad_norm")
        low, high = self.std_range
        if not 0.0 < low < self.init_std < high:
            raise BidexError(
                f"mtsac: std_range must be two positive numbers with init_std between them, got {low} {high} and "
                f"{self.init_std}."
            )


PRESETS: dict[str, MTSACConfig] = {
    # Table 43 of the Bi-DexHands appendix (SAC, "other tasks"; it has none for MT-SAC): layers, step size, discount,
    # Polyak 0.99, gradient norm, entropy coefficient 0.2 (here where each temperature starts), reward scale 1, 5000
    # steps of replay, 1 epoch of 4 mini-batches of 32 (here after every vector step, and of each task). From Table 49
    # (SAC on Humanoid) only what Table 43 leaves out: 32 steps, here between two reports. Both are silent on
    # non-linearity, bounds of the standard deviation, target entropy and warm-up, and learn no temperature.
    "paper": MTSACConfig(
        hidden=(1024, 1024, 1024),
        value_heads=False,
        critic_layer_norm=False,
        init_std=1.0,
        std_range=(2e-9, 7.4),
        replay_steps=5000,
        warmup_steps=32,
        steps_per_iteration=32,
        updates_per_step=4,
        batch_per_task=32,
        gamma=0.96,
        tau=0.01,
        learning_rate=3e-4,
        critic_learning_rate=3e-4,
        alpha_learning_rate=3e-4,
        init_alpha=0.2,
        max_grad_norm=1.0,
        normalise_observations=False,
        per_task_rewards=False,
    ),
    "laptop": MTSACConfig(),
    # MT-SAC as Meta-World's baselines run it, with one row of each task: 128 transitions of each task in an update, one
    # update a vector step, log standard deviations from -20 to 2, 100,000 transitions of each task.
    "metaworld": MTSACConfig(
        hidden=(400, 400, 400),
        value_heads=False,
        critic_layer_norm=False,
        init_std=1.0,
        std_range=(2e-9, 7.4),
        replay_steps=100_000,
        warmup_steps=4000,
        steps_per_iteration=500,
        updates_per_step=1,
        batch_per_task=128,
        gamma=0.99,
        tau=0.005,
        learning_rate=3e-4,
        critic_learning_rate=3e-4,
        alpha_learning_rate=3e-4,
        adam_eps=1e-5,
        init_alpha=1.0,
        max_grad_norm=1.0,
        normalise_observations=False,
        per_task_rewards=False,
    ),
}

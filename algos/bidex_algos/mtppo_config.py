"""What can be set about MT-PPO, and its presets; imports no torch, so that a command line can show it at once."""

from dataclasses import dataclass

from bidex_algos.choices import Activation, Autocast
from bidex_meta.errors import BidexError


@dataclass(frozen=True)
class MTPPOConfig:
    """Everything that can be set about MT-PPO; the defaults are the preset ``laptop``."""

    hidden: tuple[int, ...] = (256, 256, 128)
    """Widths of the hidden layers, of actor and critic alike."""
    activation: Activation = "elu"
    """Non-linearity of the hidden layers."""
    value_heads: bool = True
    """Give the critic one output per task instead of one for all."""
    init_std: float = 0.8
    """Standard deviation of the actions at the start."""
    std_range: tuple[float, float] = (0.05, 1.5)
    """Bounds of the standard deviation of the actions."""
    rollout_steps: int = 8
    """Steps taken in every row between two updates."""
    num_minibatches: int = 4
    """Mini-batches per epoch; each holds shuffled steps of all rows."""
    epochs: int = 4
    """Passes over the rollout per update."""
    clip: float = 0.2
    """How far the likelihood ratio may leave 1 before it earns nothing more."""
    gamma: float = 0.93
    """Discount per step."""
    lam: float = 0.95
    """Trace decay of the advantage estimate."""
    learning_rate: float = 3e-4
    """Adam's step size at the start."""
    adaptive_learning_rate: bool = True
    """Divide the step size by 1.5 when the KL exceeds twice desired_kl, multiply it when below half."""
    desired_kl: float = 0.03
    """KL of the sampling policy from the current one that the adaptive step size aims at."""
    learning_rate_range: tuple[float, float] = (1e-5, 1e-2)
    """Bounds of the adaptive step size."""
    critic_learning_rate: float | None = 1e-3
    """A fixed step size for the critic; None makes it follow the actor's."""
    value_loss_weight: float = 2.0
    """Factor of the value loss. Adam undoes it; it matters only beside max_grad_norm."""
    entropy_weight: float = 0.0
    """Factor of the entropy bonus."""
    max_grad_norm: float = 1.0
    """Gradients longer than this are shortened to it."""
    clip_apart: bool = True
    """Shorten the gradients of actor and critic apart, so that a large value error leaves the policy's step alone."""
    normalise_observations: bool = True
    """Give observations zero mean and unit variance by running statistics; the task's one-hot stays as it is."""
    per_task_values: bool = True
    """Let the critic predict returns normalised per task by running statistics."""
    value_horizon: float = 100.0
    """Iterations after which returns fade from those statistics."""
    per_task_advantages: bool = True
    """Normalise advantages within each task instead of over the whole batch."""
    autocast: Autocast = "auto"
    """Hidden layers in bfloat16; auto: on CUDA and on CPUs with AMX."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        for name in ("rollout_steps", "num_minibatches", "epochs"):
            if getattr(self, name) < 1:
                raise BidexError(f"mtppo: {name} must be at least 1, got {getattr(self, name)}.")
        for name in ("gamma", "lam"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise BidexError(f"mtppo: {name} must lie in [0, 1], got {getattr(self, name)}.")
        for name in ("std_range", "learning_rate_range"):
            low, high = getattr(self, name)
            if not 0.0 < low <= high:
                raise BidexError(f"mtppo: {name} must be two rising positive numbers, got {low} {high}.")


PRESETS: dict[str, MTPPOConfig] = {
    # Table 47 of the Bi-DexHands appendix; the value loss weight is their loader's default.
    "paper": MTPPOConfig(
        hidden=(2048, 1024, 512),
        value_heads=False,
        init_std=0.8,
        rollout_steps=8,
        num_minibatches=4,
        epochs=5,
        clip=0.2,
        gamma=0.96,
        lam=0.95,
        learning_rate=3e-4,
        desired_kl=0.016,
        critic_learning_rate=None,
        value_loss_weight=2.0,
        entropy_weight=0.0,
        max_grad_norm=1.0,
        normalise_observations=False,
    ),
    "laptop": MTPPOConfig(),
    # Meta-World's multi-task suites: discount, trace and clip are those of the MTPPO that its authors publish
    # (metaworld-algorithms). A rollout is 100 steps instead of their 10,000 and the networks are small: on MT3 one of
    # 250 steps (ELU, 8 mini-batches) had learned less after 150 k steps: 24 against 42 % in training, one seed each.
    "metaworld": MTPPOConfig(
        hidden=(256, 256, 128),
        activation="tanh",
        init_std=0.8,
        rollout_steps=100,
        num_minibatches=4,
        epochs=5,
        clip=0.2,
        gamma=0.99,
        lam=0.97,
        learning_rate=5e-4,
        desired_kl=0.02,
        std_range=(0.1, 1.5),
    ),
}

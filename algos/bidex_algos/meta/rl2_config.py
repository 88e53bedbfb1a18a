"""What can be set about RL², and its presets; imports no torch, so that a command line can show it at once."""

from dataclasses import dataclass
from typing import ClassVar

from bidex_algos.checks import at_least, between, network_bytes, positive, rising, types
from bidex_algos.choices import Activation
from bidex_algos.onpolicy.ppo_config import PPOConfig
from bidex_meta.errors import BidexError


@dataclass(frozen=True)
class TrialConfig:
    """Networks and trials of RL²."""

    hidden: tuple[int, ...] = (256, 128)
    """Widths of the encoder's layers, before the memory; of actor and critic alike."""
    activation: Activation = "elu"
    """Non-linearity of the encoder."""
    memory: int = 128
    """Numbers that a row's memory (GRU) holds; actor and critic have one each."""
    value_heads: bool = True
    """Give the critic one output per task class instead of one for all."""
    init_std: float = 0.8
    """Standard deviation of the actions at the start."""
    std_range: tuple[float, float] = (0.05, 1.5)
    """Bounds of the standard deviation of the actions."""
    episodes_per_trial: int = 3
    """Episodes of one task that the memory lasts for: those an evaluation plays to adapt, and one more."""
    max_adapt_steps: int = 150
    """Steps after which an episode of a trial is cut, if its class's time limit has not ended it."""
    blind_share: float = 0.3
    """Share of the episodes whose rewards the policy is not shown, as it is not in an evaluation."""
    reward_unit: float = 0.01
    """Rewards enter the observation as asinh(reward / reward_unit), then normalised by running statistics."""
    gamma: float = 0.93
    """Discount per step, over all episodes of a trial."""
    lam: float = 0.95
    """Trace decay of the advantage estimate."""
    chunk: int | None = None
    """Steps that gradients flow back through the memory; None, or no fewer than a trial has: the whole trial."""


@dataclass(frozen=True)
class RL2Config(PPOConfig, TrialConfig):
    """Everything that can be set about RL²; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "rl2"

    learning_rate_range: tuple[float, float] = (1e-5, 3e-3)
    """Bounds of the adaptive step size."""
    entropy_weight: float = 0.0
    """Factor of the entropy bonus."""
    max_grad_norm: float = 1.0
    """Gradients longer than this are shortened to it, actor and critic apart."""
    normalise_observations: bool = True
    """Give observations zero mean and unit variance by running statistics."""
    value_horizon: float = 100.0
    """Iterations after which returns fade from the statistics that the critic's targets are normalised by."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        types(self)
        self._check_ppo()
        at_least(self, 1, "memory", "episodes_per_trial", "max_adapt_steps")
        if self.chunk is not None:
            at_least(self, 1, "chunk")
        between(self, 0.0, 1.0, "gamma", "lam", "blind_share")
        positive(self, "init_std", "reward_unit", "max_grad_norm", "value_horizon")
        rising(self, "std_range")
        if not self.hidden:
            raise BidexError("rl2: hidden must name at least one layer, got none.")

    @property
    def trial_steps(self) -> int:
        """Most steps of a trial."""
        return self.episodes_per_trial * self.max_adapt_steps

    def bytes_held(self, rows: int, width: int) -> int:
        """About how much memory a learner takes on so many rows.

        Args:
            rows: Rows of its world.
            width: Numbers that are kept of a step of a row.
        """
        memory = 4 * 4 * 2 * 3 * self.memory * (self.memory + (self.hidden[-1]))
        return 4 * rows * width * self.trial_steps + network_bytes(self.hidden, width, 2) + memory


PRESETS: dict[str, RL2Config] = {
    # The appendix has no table for RL². Layers, epochs, mini-batches, clip, gradient norm, step size, discount, trace,
    # starting noise and KL are Table 48's, ProMP's: its outer loop is PPO too. Its 8 steps a rollout have no
    # counterpart, since a trial is made of whole episodes. Memory, ten episodes a trial and 250 steps of
    # backpropagation are those of RL² in Meta-World's baselines (metaworld-algorithms).
    "paper": RL2Config(
        hidden=(2048, 1024, 512), memory=256, value_heads=False, init_std=1.0, episodes_per_trial=10, gamma=0.9,
        lam=0.95, chunk=250, num_minibatches=1, epochs=3, clip=0.2, learning_rate=3e-4, desired_kl=0.016,
        critic_learning_rate=None, entropy_weight=0.0, max_grad_norm=1.0, normalise_observations=False,
    ),
    # Discount and KL are MT-PPO's. With 0.97, so that what an episode finds out is paid in the next, and a KL of 0.02
    # the egg of ML1-wide was carried and not thrown after 5 M steps (docs/results/ml1.md).
    "laptop": RL2Config(),
}  # fmt: skip

"""What can be set about MT-PPO, and its presets; imports no torch, so that a command line can show it at once."""

from dataclasses import dataclass
from typing import ClassVar

from bidex_algos.checks import at_least, positive
from bidex_algos.choices import Balancing
from bidex_algos.onpolicy.config import TABLE_47, OnPolicyConfig
from bidex_algos.onpolicy.ppo_config import PPOConfig
from bidex_meta.errors import BidexError


@dataclass(frozen=True)
class MTPPOConfig(PPOConfig, OnPolicyConfig):
    """Everything that can be set about MT-PPO; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "mtppo"

    value_loss_weight: float = 2.0
    """Factor of the value loss. Adam undoes it; it matters only beside max_grad_norm."""
    entropy_weight: float = 0.0
    """Factor of the entropy bonus."""
    max_grad_norm: float = 1.0
    """Gradients longer than this are shortened to it."""
    clip_apart: bool = True
    """Shorten the gradients of actor and critic apart, so that a large value error leaves the policy's step alone."""
    gradient_surgery: Balancing = "none"
    """What becomes of the tasks' policy gradients. pcgrad: each loses what points against another task's (Yu et al.
    2020). cagrad: their sum is turned towards the task that it serves worst (Liu et al. 2021). famo: losses are weighed
    so that all fall at one rate (Liu et al. 2023)."""
    cagrad_radius: float = 0.4
    """How far cagrad's direction may leave the mean gradient, in lengths of that; 0: it is the mean."""
    famo_rate: float = 0.025
    """Adam's step size of famo's weights."""
    famo_decay: float = 0.01
    """By which these weights are drawn back to even ones."""
    demonstration_weight: float = 0.1
    """With --demonstrations: weight at the start of the policy's distance from them; 0: they count nothing."""
    demonstration_half_life: float = 500_000.0
    """Environment steps in which that weight falls to half."""
    demonstration_batch: int = 256
    """Transitions of them in each mini-batch, of each process."""
    demonstration_cloning: int = 0
    """Steps of so many of them in which the policy is cloned before it plays."""
    critic_first: int = 0
    """Environment steps at the start in which the critic alone learns: for a policy that begins with a skill (cloned,
    or of --start-from), which a critic that knows nothing would spoil."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        super().__post_init__()
        self._check_ppo()
        positive(self, "max_grad_norm", "famo_rate")
        at_least(self, 0, "famo_decay", "demonstration_weight", "demonstration_cloning", "critic_first")
        at_least(self, 1, "demonstration_batch")
        positive(self, "demonstration_half_life")
        if not 0.0 <= self.cagrad_radius < 1.0:
            raise BidexError(f"mtppo: cagrad_radius must lie in [0, 1), got {self.cagrad_radius}.")


PRESETS: dict[str, MTPPOConfig] = {
    # Table 47 of the Bi-DexHands appendix; the value loss weight is their loader's default.
    "paper": MTPPOConfig(
        **TABLE_47, epochs=5, clip=0.2, learning_rate=3e-4, desired_kl=0.016, critic_learning_rate=None,
        value_loss_weight=2.0, entropy_weight=0.0,
    ),
    "laptop": MTPPOConfig(),
    # Meta-World's multi-task suites: discount, trace and clip are those of the MTPPO that its authors publish
    # (metaworld-algorithms). A rollout is 100 steps instead of their 10,000 and the networks are small: on MT3 one of
    # 250 steps (ELU, 8 mini-batches) had learned less after 150 k steps: 24 against 42 % in training, one seed each.
    "metaworld": MTPPOConfig(
        hidden=(256, 256, 128), activation="tanh", init_std=0.8, rollout_steps=100, num_minibatches=4, epochs=5,
        clip=0.2, gamma=0.99, lam=0.97, learning_rate=5e-4, desired_kl=0.02, std_range=(0.1, 1.5),
    ),
}  # fmt: skip

"""What can be set about PPO's update, in MT-PPO and RL² alike; imports no torch."""

from dataclasses import dataclass

from bidex_algos.checks import at_least, positive, rising


@dataclass(frozen=True)
class PPOConfig:
    """Passes, clip and step sizes. A config that is made of this and others puts its fields behind theirs."""

    num_minibatches: int = 4
    """Mini-batches per epoch; each holds shuffled samples of all rows."""
    epochs: int = 4
    """Passes over what was collected, per update."""
    clip: float = 0.2
    """How far the likelihood ratio may leave 1 before it earns nothing more."""
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

    def _check_ppo(self) -> None:
        """Refuses fields that are out of their range."""
        at_least(self, 1, "num_minibatches", "epochs")
        rising(self, "learning_rate_range")
        positive(self, "learning_rate", "desired_kl", "clip")

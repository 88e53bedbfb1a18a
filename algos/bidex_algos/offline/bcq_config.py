"""What can be set about BCQ, and its presets; imports no torch, so that a command line can show it at once."""

from dataclasses import dataclass
from typing import ClassVar

from bidex_algos.checks import at_least, between, network_bytes, positive
from bidex_algos.offline.config import PAPER, CriticConfig


@dataclass(frozen=True)
class BCQConfig(CriticConfig):
    """Everything that can be set about BCQ; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "bcq"

    vae_hidden: tuple[int, ...] = (256, 256)
    """Widths of the hidden layers of the model of the data's actions, a variational autoencoder."""
    vae_learning_rate: float = 1e-3
    """Adam's step size for it."""
    latent: int = 2
    """Entries of its code, for each action."""
    kl_weight: float = 0.5
    """Weight of the codes' divergence from a standard normal beside the squared error of an action."""
    candidates: int = 10
    """Actions that are drawn for a state; the best one is taken."""
    perturbation: float = 0.05
    """The most by which a candidate is changed (Phi)."""
    lower_weight: float = 0.75
    """Weight of the lower of both critics in a target; the higher one has the rest."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        super().__post_init__()
        at_least(self, 1, "latent", "candidates")
        at_least(self, 0, "kl_weight")
        between(self, 0.0, 1.0, "lower_weight")
        between(self, 0.0, 2.0, "perturbation")
        positive(self, "vae_learning_rate")

    def bytes_held(self, rows: int, width: int) -> int:
        """As of its base, with the autoencoder."""
        return super().bytes_held(rows, width) + network_bytes(self.vae_hidden, width, 2)


# "paper": layers, step size, batch, Phi and the number of actions are Table 46's; the autoencoder's layers, its weight
# and lower_weight, which it leaves out, those of Fujimoto et al. (2019, their code).
PRESETS: dict[str, BCQConfig] = {
    "paper": BCQConfig(
        hidden=(400, 300), vae_hidden=(750, 750), learning_rate=1e-3, critic_learning_rate=1e-3, batch_size=100,
        normalise_observations=False, **PAPER,
    ),
    "laptop": BCQConfig(),
}  # fmt: skip

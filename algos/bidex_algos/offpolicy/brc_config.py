"""What can be set about BRC, and its presets; imports no torch, so that a command line can show it at once."""

from dataclasses import dataclass
from typing import ClassVar

from bidex_algos.offpolicy.categorical_config import CategoricalConfig
from bidex_algos.offpolicy.mtsac_config import MTSACConfig
from bidex_meta.errors import BidexError


@dataclass(frozen=True)
class BRCConfig(CategoricalConfig, MTSACConfig):
    """Everything that can be set about BRC; the defaults are the preset ``laptop``."""

    algo: ClassVar[str] = "brc"

    critic_hidden: tuple[int, ...] = (256, 256, 256)
    """Width of the critics as often as there are residual blocks of two layers, and once more for the first layer."""
    hidden: tuple[int, ...] = (256, 256)
    """The same of the actor."""
    value_heads: bool = False
    """Give each critic one distribution per task instead of one for all."""
    task_embedding: int = 32
    """Size of a learned vector that each network reads in the place of the task's one-hot; 0: the one-hot itself."""
    updates_per_step: int = 4
    """Updates of all networks after each vector step."""
    n_steps: int = 3
    """Steps whose rewards a target takes as they came, before it asks for the value of what follows."""
    tau: float = 0.05
    """Share of the critics that enters the target critics in each update (1 - Polyak's factor)."""
    clipped_double_q: bool = False
    """Targets and actor take the critic that says less; off: the mean of both."""
    weight_decay: float = 1e-4
    """Share of its step size by which each step shortens all weights of actor and critics (AdamW)."""
    target_entropy_per_action: float = -0.5
    """Entropy of the squashed policy that each temperature aims at, for each action; uniform actions have 0.69."""
    one_temperature: bool = False
    """One temperature for all tasks, led by their mean entropy."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        super().__post_init__()
        if not self.shares_a_trunk:
            raise BidexError(f"{self.algo}: its networks are residual; architecture must be shared or multi_head.")
        for name in ("hidden", "critic_hidden"):
            widths = getattr(self, name)
            if len(set(widths)) != 1:
                raise BidexError(f"{self.algo}: {name} must be one width, once or more often, got {widths}.")


PRESETS: dict[str, BRCConfig] = {
    # The authors' code (github.com/naumix/BiggerRegularizedCategorical, 2025). train.py: batches of 1,024 in all, 2
    # updates a vector step, critics 4,096 wide; there each task has one row, 5,000 transitions of it come first and
    # 1,000,000 are kept: here as many at 256 rows of each task. jaxrl/agent/brc_learner.py: 2 blocks, the actor 256
    # with 1, embedding of 32, steps of 3e-4, discount 0.99, tau 0.005, entropy -1/2 per action, one temperature from
    # 0.1, 101 atoms to 10. jaxrl/networks.py: ReLU, log standard deviations from -10 to 2, which begin in the middle.
    # Decay: AdamW's default there, 1e-4. No limit of the gradient (here a huge one), observations as they are.
    "paper": BRCConfig(
        hidden=(256, 256), critic_hidden=(4096, 4096, 4096), replay_steps=4000, warmup_steps=20, updates_per_step=2,
        batch_size=1024, gamma=0.99, n_steps=1, tau=0.005, learning_rate=3e-4, critic_learning_rate=3e-4,
        alpha_learning_rate=3e-4, init_alpha=0.1, one_temperature=True, std_range=(4.54e-5, 7.39), init_std=0.0183,
        weight_decay=1e-4, max_grad_norm=1e9, normalise_observations=False, atoms=101, value_bound=10.0,
    ),
    "laptop": BRCConfig(),
}  # fmt: skip

"""What can be set about learners whose critics give distributions; imports no torch."""

from dataclasses import dataclass

from bidex_algos.checks import at_least, network_bytes, positive
from bidex_algos.offpolicy.config import OffPolicyConfig


@dataclass(frozen=True)
class CategoricalConfig(OffPolicyConfig):
    """The critics' distributions and layers, beside what all off-policy learners have."""

    critic_hidden: tuple[int, ...] = (256, 256)
    """Widths of the hidden layers of the critics; ``hidden`` is then the actor's alone."""
    atoms: int = 101
    """Values that a distribution of the return gives probabilities to."""
    value_bound: float = 10.0
    """They lie evenly from minus this to this, in scaled rewards."""
    clipped_double_q: bool = True
    """Targets and actor take the critic that says less; off: the mean of both."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        super().__post_init__()
        at_least(self, 2, "atoms")
        positive(self, "value_bound")

    def bytes_held(self, rows: int, width: int) -> int:
        """About how much memory a learner takes: as in the base, where ``hidden`` is of all networks, and the critics'.

        Args:
            rows: Rows of its world.
            width: Numbers that are kept of a step of a row.
        """
        return super().bytes_held(rows, width) + network_bytes((*self.critic_hidden, self.atoms), width, 2)

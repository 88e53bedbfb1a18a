"""What can be set about the planner; imports no torch, so that a command line can show it at once."""

from dataclasses import dataclass

from bidex_meta.errors import BidexError
from bidex_meta.fields import check_fields


@dataclass(frozen=True)
class PlannerConfig:
    """Everything that can be set about the planner."""

    samples: int = 128
    """Action sequences per round."""
    copies: int = 1
    """Slightly shifted states that are played side by side, a divisor of ``samples``: each sequence meets one of them,
    the best ones of a plan meet all, and their mean counts: no plan that holds by luck."""
    rounds: int = 3
    """Rounds per plan."""
    first_rounds: int = 10
    """Rounds of the first plan, which has no predecessor."""
    rounds_after: int = 1
    """Rounds per plan once the task has been solved."""
    elite_share: float = 0.08
    """Share of the sequences that mean and deviation move towards."""
    kept_elites: int = 8
    """Elites that are tried again in the next round, and as parents of mutants."""
    mutants: float = 0.5
    """Share of the sequences that are an elite with some of its knots changed; the rest is drawn around the mean."""
    mutated: float = 0.15
    """Share of the actions that a mutant changes which does not change one part of the hands."""
    horizon: int = 41
    """Control steps a plan looks ahead."""
    knots: int = 9
    """Knots of a plan; actions between them are interpolated linearly."""
    execute: int = 10
    """Control steps played before the next plan; whole spaces between knots keep the rest of the plan as it was."""
    std: float = 0.5
    """Deviation of the knots in a first round; a sequence takes a share of it, from all to a twentieth."""
    min_std: float = 0.12
    """The deviation never falls below this."""
    gamma: float = 0.97
    """Discount per control step."""
    effort: float = 0.05
    """Price of a control step of a base's full force or torque, in units of reward. A full force is up to 800 N: for
    free, a hand soon presses on its table so hard that nothing moves it any more."""
    seed: int = 0
    """Of the samples."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        check_fields(self, "planner")
        for name in ("samples", "copies", "rounds", "first_rounds", "rounds_after", "kept_elites", "execute"):
            if getattr(self, name) < 1:
                raise BidexError(f"planner: {name} must be at least 1, got {getattr(self, name)}.")
        for name in ("knots", "horizon"):
            if getattr(self, name) < 2:
                raise BidexError(f"planner: {name} must be at least 2, got {getattr(self, name)}.")
        for name, low, high in (("elite_share", 0.0, 1.0), ("mutants", 0.0, 1.0), ("mutated", 0.0, 1.0)):
            if not low <= getattr(self, name) <= high:
                raise BidexError(f"planner: {name} must lie in [{low:g}, {high:g}], got {getattr(self, name)}.")
        for name in ("std", "min_std", "gamma", "effort"):
            if getattr(self, name) < 0.0:
                raise BidexError(f"planner: {name} must be at least 0, got {getattr(self, name)}.")
        if self.samples % self.copies:
            raise BidexError(f"Expected samples that copies divide, got {self.samples} and {self.copies}.")

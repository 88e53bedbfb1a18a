"""What can be set about the planner; imports no torch, so that a command line can show it at once."""

from dataclasses import dataclass


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

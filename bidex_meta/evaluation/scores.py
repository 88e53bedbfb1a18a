"""What an episode counts for: the normalised score, and the return of an episode in which the physics broke."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Reference:
    """What a class's return is measured against."""

    random: float
    """Mean return of uniform actions."""
    expert: float | None = None
    """Mean return of the best known policy; None where none is known that is above the floor."""
    zero: float | None = None
    """Mean return of zero actions, where it is known."""

    @property
    def floor(self) -> float:
        """The score's zero: what a policy that has learned nothing gets, by doing anything or nothing."""
        return self.random if self.zero is None else max(self.random, self.zero)

    def scores(self, returns: np.ndarray) -> np.ndarray | None:
        """100 · (R − R_floor) / (R_expert − R_floor) of every return R; None without an expert above the floor."""
        if self.expert is None or self.expert <= self.floor:
            return None
        return 100 * (returns - self.floor) / (self.expert - self.floor)


def counted_returns(
    returns: np.ndarray, broken: np.ndarray, reference: Reference | None, finished: np.ndarray
) -> np.ndarray:
    """Returns of a class's episodes, such that nothing is gained by breaking physics.

    A broken episode ends early, which would pay wherever rewards are negative, or after the best of what it could earn.
    So it counts with the return of random actions or, where that is not known, of the worst episode that was finished;
    with its own if that is lower, or if there is neither.

    Args:
        returns: Sums of the unscaled reward, shape (episodes,).
        broken: Which of them ended because the physics broke, shape (episodes,), bool.
        reference: The class's, where there is one.
        finished: Returns of the class's finished episodes, of this policy and of those it is compared with, shape (n,).
    """
    others = finished if reference is None else np.array([reference.random])
    bound = others.min() if len(others) else np.inf
    return np.where(broken, np.minimum(returns, bound), returns)

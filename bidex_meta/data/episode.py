"""One recorded episode."""

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Episode:
    """T transitions of one row, from a start to an end.

    Attributes:
        observations: (T + 1, d), float32: the start, and what each transition led to.
        actions: (T, a), float32, as the world took them: clipped to [-1, 1].
        rewards: (T,), float32, as the world gave them: with the suite's scale of the class.
        terminated: (T,), bool: true at most at the last one, where the episode came to a true end.
        truncated: (T,), bool: the same of an end by time, or before a broken transition.
        task: Slot of the world.
        task_name: Its name: a class, or ``Class/task``.
        task_index: Task of the slot's pool.
        variation: (v,), float64: what that task freezes; empty where the world tells none.
        success: Whether the goal was met after any of the transitions.
        broken: Whether physics broke in the transition after the last one, which is left out.
        return_unscaled: Sum of the rewards by the printed formula, before the suite's scale.
        row: Row of the world, counted over all processes' rows in each process on its own.
        policy: Which of several policies acted, from 0 on.
    """

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    task: int = 0
    task_name: str = ""
    task_index: int = 0
    variation: np.ndarray = field(default_factory=lambda: np.zeros(0))
    success: bool = False
    broken: bool = False
    return_unscaled: float = 0.0
    row: int = 0
    policy: int = 0

    def __len__(self) -> int:
        """Transitions, T."""
        return len(self.rewards)

"""One collected episode."""

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Episode:
    """T transitions of one environment, from a start to an end.

    Attributes:
        observations: (T + 1, d), float32: the start, and the state after each transition.
        actions: (T, a), float32, clipped to [-1, 1].
        rewards: (T,), float32, with the suite's scale of the class.
        terminated: (T,), bool: true at most for the last transition.
        truncated: (T,), bool: likewise, by time, or before a broken transition.
        task: Slot of the world.
        task_name: Its name: a class, or ``Class/task``.
        task_index: Task of the slot's pool.
        variation: (v,), float64: what that task freezes; empty where the world has none.
        success: Whether the goal was met after any transition.
        broken: Whether physics broke in the next transition, which is left out.
        return_unscaled: Sum of the rewards by the printed formula, before the suite's scale.
        row: Environment of the process's world.
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

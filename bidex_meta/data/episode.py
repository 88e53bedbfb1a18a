"""One collected episode."""

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Episode:
    """T transitions of one environment, from a start to an end."""

    observations: np.ndarray  # (T + 1, d), float32: the start, and the state after each transition
    actions: np.ndarray  # (T, a), float32, clipped to [-1, 1]
    rewards: np.ndarray  # (T,), float32, with the suite's scale of the class
    terminated: np.ndarray  # (T,), bool: true at most for the last transition
    truncated: np.ndarray  # (T,), bool: likewise, by time, or before a broken transition
    task: int = 0  # slot of the world
    task_name: str = ""  # its name: a class, or ``Class/task``
    task_index: int = 0  # task of the slot's pool
    variation: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (v,), float64: what that task freezes, if any
    success: bool = False  # whether the goal was met after any transition
    broken: bool = False  # whether physics broke in the next transition, which is left out
    return_unscaled: float = 0.0  # sum of the rewards by the printed formula, before the suite's scale
    row: int = 0  # environment of the process's world
    policy: int = 0  # which of several policies acted, from 0 on

    def __len__(self) -> int:
        """Transitions, T."""
        return len(self.rewards)

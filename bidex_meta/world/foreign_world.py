"""Worlds of other libraries' environments, on the CPU: the base that each library's world extends.

Our learners, evaluation and checkpoints run on these worlds unchanged. A subclass starts and steps the environments.
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from torch import Tensor

from bidex_meta.world.base import BatchedWorld, Outcome, Slots, Transition
from bidex_meta.world.contract import State, plain_groups
from bidex_meta.world.random import uniform

_TASK_DRAW = 0
_ELAPSED_DRAW = 1
OWN_DRAWS = 2


class Sizes(NamedTuple):
    """Sizes of an environment of another library.

    ``state`` is the number of observation entries without the class's one-hot, ``action`` is the number of action
    entries, and ``episode`` is the time limit in steps.
    """

    state: int
    action: int
    episode: int


class ForeignWorld(BatchedWorld):
    """Environments of another library's classes; each class is a slot, and ``sizes`` applies to all of them.

    An observation has the class's own numbers. If there are several classes, a one-hot vector of the class follows. In
    SAME_STEP mode each episode draws one of its class's tasks; in DISABLED mode environment j of a class keeps task j
    modulo the number of tasks.
    """

    def __init__(
        self,
        names: Sequence[str],
        num_envs: int,
        sizes: Sizes,
        seed: int = 0,
        autoreset_mode: str | AutoresetMode | None = None,
        stagger: bool = True,
    ) -> None:
        """Set up spaces and episodes; a subclass creates the environments. Raises the errors of ``BatchedWorld``."""
        count = len(names)
        slots = Slots(list(names), [sizes.episode] * count, [1.0] * count, [None] * count, [1] * count)
        super().__init__(slots, num_envs, torch.device("cpu"), autoreset_mode, stagger, seed)
        self.num_id_columns = count if count > 1 else 0
        self.observation_groups = plain_groups(sizes.state + self.num_id_columns, self.num_id_columns)
        low = np.full(sizes.state + self.num_id_columns, -np.inf, np.float32)
        high = np.full_like(low, np.inf)
        low[sizes.state :] = 0.0
        high[sizes.state :] = 1.0
        self._set_spaces(Box(low, high, dtype=np.float32), sizes.action)
        if self.num_id_columns:
            self._obs[:, sizes.state :] = torch.eye(count)[self.task_id]
        # A frozen environment keeps the success of its last transition.
        self._success = torch.zeros(self.num_envs, dtype=torch.bool)

    def _draws(self, num: int) -> Tensor:
        """Return uniform numbers in [0, 1), (n, num), for each environment's running episode.

        The numbers depend only on seed, environment and episode.
        """
        return uniform(self._keys, self.episodes.number, num)

    def _start(self, mask: Tensor, stagger: bool) -> None:
        draws = uniform(self._keys, self.episodes.number + mask, OWN_DRAWS)
        tasks = self.task_index
        if self.autoreset_mode != AutoresetMode.DISABLED:
            tasks = (draws[:, _TASK_DRAW] * self._pool_size).long()
        self._count_episodes(mask, tasks, draws[:, _ELAPSED_DRAW], stagger)
        self._place(mask)

    @abstractmethod
    def _place(self, mask: Tensor) -> None:
        """Start the task of each environment in a mask (``task_index``), and write its first state into ``_obs``."""

    def _move(self, active: Tensor, broken: Tensor) -> Outcome:
        reward, terminated, truncated, info = self._finish(active, broken, self._advance(active, broken))
        self._success = info["success"].clone()
        return reward, terminated, truncated, info

    @abstractmethod
    def _advance(self, active: Tensor, broken: Tensor) -> Transition:
        """Step the ``active`` environments with the actions in ``_action``, and return the transition.

        For inactive environments the caller reads only the fields ``success`` and ``unstable``. ``broken`` marks active
        environments whose action was not finite; the caller ignores their transition.
        """

    def state_dict(self) -> State:
        """Return the state; see ``BatchedWorld``."""
        return super().state_dict() | {"success": self._success.clone()}

    def _restore(self, state: State) -> None:
        super()._restore(state)
        self._success = state["success"].clone()

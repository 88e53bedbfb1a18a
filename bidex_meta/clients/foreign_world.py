"""Foreign environments behind the face of ``bidex_meta.World``: what is the same whoever steps them.

Our learners, evaluation and checkpoints run on such worlds unchanged. A subclass starts rows and advances them;
episodes, draws, time limits, flags and ``info`` are kept here as ``world/contract.py`` says, on the CPU.
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from torch import Tensor

from bidex_meta.errors import BidexError
from bidex_meta.world.actions import clean
from bidex_meta.world.autoreset import checked_mode, checked_seed, reset_mask
from bidex_meta.world.checked import fits
from bidex_meta.world.contract import plain_groups
from bidex_meta.world.copying import Recreated
from bidex_meta.world.ends import Clock, ended_info
from bidex_meta.world.episodes import Episodes
from bidex_meta.world.groups import split_rows
from bidex_meta.world.random import row_keys, uniform
from bidex_meta.world.spaces import make_spaces

_TASK_DRAW, _ELAPSED_DRAW, _DRAWS = 0, 1, 2


class Sizes(NamedTuple):
    """Of each row: entries of its state as observed (no one-hot) and of its action; its time limit in steps."""

    state: int
    action: int
    episode: int


class Transition(NamedTuple):
    """What a step made of all rows; those that were not to be stepped keep their observation and get zeros.

    Observations (n, d), rewards (n,), and per row whether it is at its goal, came to an end of its own, and broke.
    """

    obs: Tensor
    reward: Tensor
    success: Tensor
    terminated: Tensor
    broken: Tensor


class ForeignWorld(Recreated, VectorEnv):
    """Rows of foreign classes, split evenly and contiguously over them, on the CPU: a ``contract.TaskWorld``.

    Observations are the class's own numbers, with its one-hot behind them where there are several. In SAME_STEP mode
    each episode draws one of its class's tasks, and first episodes may begin at a random elapsed step; in DISABLED mode
    row j of a class keeps task j modulo the number of tasks.
    """

    single_observation_space: Box
    single_action_space: Box
    observation_space: Box
    action_space: Box

    def __init__(
        self,
        names: Sequence[str],
        num_envs: int,
        sizes: Sizes,
        seed: int = 0,
        autoreset_mode: str | AutoresetMode | None = None,
        stagger: bool = True,
    ) -> None:
        """Keeps the rows' books; a subclass makes what it steps.

        Args:
            names: Of the classes, its slots.
            num_envs: Rows over all classes, at least one for each.
            sizes: Of states, actions and episodes.
            seed: Of the draws until ``reset(seed=...)`` says otherwise.
            autoreset_mode: SAME_STEP (training) or DISABLED (evaluation), as a member or its name.
            stagger: Whether the first episode of each row begins at a random elapsed step (SAME_STEP alone).

        Raises:
            BidexError: Unknown mode, or too few rows.
        """
        self.task_names, self.num_envs, self.device = list(names), num_envs, torch.device("cpu")
        self.num_tasks = len(names)
        self.num_id_columns = self.num_tasks if self.num_tasks > 1 else 0
        self.gammas: tuple[float | None, ...] = (None,) * self.num_tasks
        if num_envs < self.num_tasks:
            raise BidexError(f"Expected at least {self.num_tasks} rows, one for each class, got {num_envs}.")
        self.autoreset_mode = checked_mode(autoreset_mode)
        self.stagger = stagger
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": []}
        self._sizes = sizes
        self.slot_rows = split_rows(num_envs, self.num_tasks)
        counts = [rows.stop - rows.start for rows in self.slot_rows]
        self.task_id = torch.arange(self.num_tasks).repeat_interleave(torch.tensor(counts))
        self._index_in_slot = torch.cat([torch.arange(count) for count in counts])
        self.max_episode_steps = torch.full((num_envs,), sizes.episode)
        self._clock = Clock(num_envs, self.device)
        self._make_spaces()
        self._obs = torch.zeros(self.observation_space.shape or ())
        if self.num_id_columns:
            self._obs[:, sizes.state :] = torch.eye(self.num_tasks)[self.task_id]
        self._success = torch.zeros(num_envs, dtype=torch.bool)  # of the last transition: a frozen row keeps its own
        self._ready = False
        self._seed_rows(seed)
        self._set_pool_sizes([1] * self.num_tasks)

    def _make_spaces(self) -> None:
        low, high = (
            np.concatenate([np.full(self._sizes.state, far), np.full(self.num_id_columns, one_hot)]).astype(np.float32)
            for far, one_hot in ((-np.inf, 0.0), (np.inf, 1.0))
        )
        spaces = make_spaces(Box(low, high, dtype=np.float32), self._sizes.action, self.num_envs)
        self.single_observation_space, self.single_action_space = spaces.single_observation, spaces.single_action
        self.observation_space, self.action_space = spaces.observation, spaces.action
        self.observation_groups = plain_groups(self._sizes.state + self.num_id_columns, self.num_id_columns)

    def _seed_rows(self, seed: int) -> None:
        self.seed = int(seed)
        pairs = zip(self.task_names, self.slot_rows, strict=True)
        self._keys = torch.cat([row_keys(self.seed, name, r.stop - r.start, self.device) for name, r in pairs])
        self.episodes = Episodes.fresh(self.num_envs, self.device)

    def _set_pool_sizes(self, sizes: list[int]) -> None:
        """Each class has so many tasks now; the next reset must be of all rows."""
        self.num_slot_tasks = sizes
        self._pool_size = torch.tensor(sizes)[self.task_id]
        self.task_index = self._index_in_slot % self._pool_size
        self._ready = False

    def _draws(self, num: int) -> Tensor:
        """Uniform numbers of the rows' running episodes, (n, num), a function of seed, row and episode."""
        return uniform(self._keys, self.episodes.number, num)

    @abstractmethod
    def _start(self, mask: Tensor) -> None:
        """Starts the rows of a mask on ``task_index`` and writes their states into ``_obs``."""

    @abstractmethod
    def _advance(self, action: Tensor, active: Tensor, broken: Tensor) -> Transition:
        """Steps the active rows whose action is not broken.

        Args:
            action: Shape (n, a), finite, in [-1, 1].
            active: Rows whose episode runs.
            broken: Those of them whose action was not finite.
        """

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        """Starts episodes.

        Args:
            seed: Starts all draws anew; None goes on with the next episodes of the old seed.
            options: ``reset_mask``: which rows to start, shape (num_envs,), bool; all by default.

        Returns:
            Observations (num_envs, d) and an empty info.
        """
        mask = reset_mask(options, self.num_envs, self.device, self._ready)
        if seed is not None:
            self._seed_rows(checked_seed(seed, mask))
        first = not self._ready or seed is not None
        stagger = self.stagger and first and self.autoreset_mode == AutoresetMode.SAME_STEP
        self._ready = True
        self._begin(mask, stagger)
        return self._obs.clone(), {}

    def _begin(self, mask: Tensor, stagger: bool) -> None:
        """Starts new episodes in the rows of a mask and writes their observations."""
        self._clock.begin(mask)
        self.episodes.number = self.episodes.number + mask
        draws = self._draws(_DRAWS)
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            task_index = (draws[:, _TASK_DRAW] * self._pool_size).long()
            self.task_index = torch.where(mask, task_index, self.task_index)
        elapsed = (draws[:, _ELAPSED_DRAW] * self._sizes.episode * stagger).long()
        self.episodes.begin(mask, elapsed)
        self._start(mask)

    def step(self, actions: Tensor | np.ndarray) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Advances every row by one control step.

        Args:
            actions: Shape (num_envs, a), clipped to [-1, 1]; a row with a non-finite number ends as unstable.

        Returns:
            Observations (num_envs, d), rewards, terminated and truncated (num_envs,), and info. In SAME_STEP mode the
            observation of an ended row is already that of its next episode; ``final_obs`` has the last one.

        Raises:
            BidexError: A wrong shape, or no reset since the world was made or got other tasks.
        """
        action, size = torch.as_tensor(actions, dtype=torch.float32), self._sizes.action
        if not self._ready:
            raise BidexError("Expected reset() before step(): the rows have no episode yet.")
        if action.shape != (self.num_envs, size):
            raise BidexError(f"Expected actions of shape ({self.num_envs}, {size}), got {tuple(action.shape)}.")
        action, broken = clean(action)
        active = ~self.episodes.finished
        return self._finish(active, self._advance(action, active, broken & active))

    def _finish(self, active: Tensor, made: Transition) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Turns the rows' transitions into what ``step`` returns, and starts new episodes."""
        episodes, success = self.episodes, made.success
        episodes.add(active, made.reward, made.reward, success)
        fell = made.terminated & active & ~made.broken
        late = episodes.elapsed >= self.max_episode_steps
        ended = (late | made.broken | fell) & active
        terminated, truncated = fell | episodes.terminated, (ended & ~fell) | episodes.truncated
        info: dict[str, Any] = {
            "success": success,
            "unstable": made.broken,
            "reward_unscaled": made.reward.clone(),
            "final_obs": made.obs,
            "_final_obs": ended,
            "so_far": episodes.statistics(),
            "counted": ended & episodes.counts,
        }
        if ended.any():
            info |= ended_info(info)
            self._clock.stamp(info)
        self._obs, self._success = made.obs.clone(), success.clone()
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            if ended.any():
                self._begin(ended, stagger=False)
        else:
            episodes.terminated, episodes.truncated = terminated.clone(), truncated.clone()
            episodes.finished = episodes.finished | ended
        return self._obs.clone(), made.reward, terminated, truncated, info

    def state_dict(self) -> dict[str, Any]:
        """Everything that decides the future of the world: tensors and plain values, copied."""
        return {
            "seed": self.seed,
            "episodes": self.episodes.state_dict(),
            "task_index": self.task_index.clone(),
            "observation": self._obs.clone(),
            "success": self._success.clone(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Puts back what ``state_dict`` gave, on a world made alike.

        Raises:
            BidexError: The state is of another number of rows or other sizes, or damaged.
        """
        fits(state, self.state_dict())
        self._seed_rows(int(state["seed"]))
        self.episodes.load_state_dict(state["episodes"])
        self.task_index = state["task_index"].clone()
        self._obs, self._success = state["observation"].clone(), state["success"].clone()
        self._ready = True

"""What the small worlds of the tests share: all of ``bidex_meta.world.contract.TaskWorld`` but their motion."""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from torch import Tensor

from bidex_meta.errors import BidexError
from bidex_meta.world.base import split_envs
from bidex_meta.world.checked import clean
from bidex_meta.world.contract import Info, Options, State, Step, plain_groups
from bidex_meta.world.episodes import Clock, Episodes, checked_mode, checked_seed, ended_info, reset_mask


class FakeWorld(ABC):
    """Rows of slots, episodes, modes and ``info``.

    A subclass names its tensors in ``kept``, and gives ``_start`` (new states in the rows of a mask), ``_observe``
    (observations (N, d) of all rows) and ``_advance`` (moves the active rows). ``tasks`` counts those of each slot,
    ``sizes`` entries of an observation and actions, ``limits`` steps of each slot; with ``one_hot`` an observation
    ends with the slot's; ``unstable`` are (step, row) pairs where physics breaks.
    """

    kept: tuple[str, ...] = ()
    success_at_end = False

    def __init__(
        self,
        tasks: dict[str, int],
        num_envs: int,
        sizes: tuple[int, int],
        limits: tuple[int, ...],
        mode: str = "SAME_STEP",
        *,
        seed: int = 0,
        one_hot: bool = False,
        unstable: tuple[tuple[int, int], ...] = (),
    ):
        self.task_names, self.num_tasks, self.num_envs = list(tasks), len(tasks), num_envs
        self.gammas: tuple[float | None, ...] = (None,) * self.num_tasks
        self.device = torch.device("cpu")
        self.autoreset_mode = checked_mode(mode)
        self.metadata: Info = {"autoreset_mode": self.autoreset_mode}
        self.num_id_columns = self.num_tasks if one_hot else 0
        self.single_observation_space = Box(-np.inf, np.inf, (sizes[0],), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (sizes[1],), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_groups = plain_groups(sizes[0], self.num_id_columns)
        self.slot_env_ids = split_envs(num_envs, self.num_tasks)
        counts = torch.tensor([rows.stop - rows.start for rows in self.slot_env_ids])
        self.task_id = torch.arange(self.num_tasks).repeat_interleave(counts)
        self._index_in_slot = torch.cat([torch.arange(int(count)) for count in counts])
        self.max_episode_steps = torch.tensor(limits)[self.task_id]
        self.unstable, self.steps, self._clock = unstable, 0, Clock(num_envs, self.device)
        self._obs = torch.zeros(num_envs, sizes[0])
        self._seed_rows(seed)
        self._set_pool_sizes(list(tasks.values()))

    def _set_pool_sizes(self, sizes: list[int]) -> None:
        self.num_slot_tasks = sizes
        self.task_index = self._index_in_slot % torch.tensor(sizes)[self.task_id]
        self._ready = False

    def _seed_rows(self, seed: int) -> None:
        self.seed, self.generator = seed, torch.Generator().manual_seed(seed)
        self.episodes = Episodes.fresh(self.num_envs, self.device)

    @abstractmethod
    def _start(self, mask: Tensor) -> None: ...

    @abstractmethod
    def _observe(self) -> Tensor: ...

    @abstractmethod
    def _advance(self, action: Tensor, active: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Rewards before their scale, successes and true ends, each (N,); ``active`` rows alone are to move."""

    def _broken(self) -> Tensor:
        """Rows whose physics breaks in this step, bool (N,)."""
        broken = torch.zeros(self.num_envs, dtype=torch.bool)
        broken[[row for step, row in self.unstable if step == self.steps]] = True
        return broken

    def _scaled(self, unscaled: Tensor) -> Tensor:
        return unscaled

    def _first_elapsed(self) -> Tensor:
        """Steps that the first episodes of a SAME_STEP world begin with, (N,)."""
        return torch.zeros_like(self.episodes.elapsed)

    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[Tensor, Info]:
        mask = reset_mask(options, self.num_envs, self.device, self._ready)
        if seed is not None:
            self._seed_rows(checked_seed(seed, mask))
        first = not self._ready or seed is not None
        self._ready = True
        self._begin(mask, first and self.autoreset_mode != AutoresetMode.DISABLED)
        self._obs = torch.where(mask[:, None], self._observe(), self._obs)
        return self._obs.clone(), {}

    def _begin(self, mask: Tensor, stagger: bool = False) -> None:
        self._clock.begin(mask)
        self.episodes.number = self.episodes.number + mask
        elapsed = self._first_elapsed() if stagger else torch.zeros_like(self.episodes.elapsed)
        self.episodes.begin(mask, elapsed)
        self._start(mask)

    def step(self, action: Tensor | np.ndarray) -> Step:
        if not self._ready:
            raise BidexError("Expected reset() before step(): the rows have no episode yet.")
        action = torch.as_tensor(action, dtype=torch.float32)
        if action.shape != self.action_space.shape:
            raise BidexError(f"Expected actions of shape {self.action_space.shape}, got {tuple(action.shape)}.")
        action, broken = clean(action)
        episodes, active = self.episodes, ~self.episodes.finished
        broken = (broken | self._broken()) & active
        self.steps += 1
        moved = active & ~broken
        unscaled, success, failed = self._advance(action, moved)
        unscaled, success = torch.where(moved, unscaled, 0.0), success & ~broken
        reward = self._scaled(unscaled)
        episodes.add(active, reward, unscaled, success, broken)
        terminated = failed & moved | episodes.terminated
        late = (episodes.elapsed >= self.max_episode_steps) & ~terminated
        truncated = (late | broken) & active | episodes.truncated
        final_obs = torch.where(moved[:, None], self._observe(), self._obs)
        return self._end(active, broken, final_obs, reward, terminated, truncated, success, unscaled)

    def _end(
        self, active: Tensor, broken: Tensor, final_obs: Tensor, reward: Tensor, terminated: Tensor, truncated: Tensor,
        success: Tensor, unscaled: Tensor,
    ) -> Step:  # fmt: skip
        """Tells the step, and begins new episodes or keeps the flags of ended ones."""
        episodes, ended = self.episodes, (terminated | truncated) & active
        info: Info = {
            "success": episodes.solved_at_end.clone() if self.success_at_end else success.clone(),
            "unstable": broken,
            "reward_unscaled": unscaled.clone(),
            "reward_terms": {"all": unscaled},
            "final_obs": final_obs,
            "_final_obs": ended,
            "running": episodes.statistics(self.success_at_end),
            "episode_mask": ended & episodes.counts,
        }
        if ended.any():
            info |= ended_info(info)
            self._clock.stamp(info)
        self._obs = final_obs.clone()
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            self._begin(ended)
            self._obs = torch.where(ended[:, None], self._observe(), self._obs)
        else:
            episodes.terminated, episodes.truncated = terminated.clone(), truncated.clone()
            episodes.finished = episodes.finished | ended
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            terminated, truncated = terminated & active, truncated & active
            self._begin(~active)
            self._obs = torch.where(active[:, None], self._obs, self._observe())
        return self._obs.clone(), reward.clone(), terminated, truncated, info

    def state_dict(self) -> State:
        return {
            "seed": self.seed,
            "generator": self.generator.get_state(),
            "episodes": self.episodes.state_dict(),
            "observation": self._obs.clone(),
            "steps": self.steps,
            "kept": {name: getattr(self, name).clone() for name in self.kept},
        }

    def load_state_dict(self, state: State) -> None:
        self._seed_rows(int(state["seed"]))
        self.generator.set_state(state["generator"])
        self.episodes.load_state_dict(state["episodes"])
        self._obs, self.steps = state["observation"].clone(), int(state["steps"])
        for name, value in state["kept"].items():
            setattr(self, name, value.clone())
        self._ready = True

    def close(self) -> None:  # noqa: B027
        """Nothing is held."""


class FakePools(FakeWorld):
    """A fake whose tasks are points, (n, 2), that can be replaced: row j of a slot has ``goal`` j mod n."""

    def __init__(self, pools: dict[str, np.ndarray], num_envs: int, *given: Any, **more: Any):
        super().__init__({name: len(tasks) for name, tasks in pools.items()}, num_envs, *given, **more)
        self._set_pools(list(pools.values()))

    def set_tasks(self, pools: dict[str, np.ndarray]) -> None:
        merged = list(self.pools)
        for name, tasks in pools.items():
            if name not in self.task_names:
                raise BidexError(f"Expected a slot among {', '.join(self.task_names)}, got {name!r}.")
            tasks = np.asarray(tasks, dtype=np.float64)
            if tasks.ndim != 2 or len(tasks) == 0 or tasks.shape[1] != 2:
                raise BidexError(f"Expected tasks of {name} with shape (n, 2), got {tasks.shape}.")
            merged[self.task_names.index(name)] = tasks
        self._set_pools(merged)

    def _set_pools(self, pools: list[np.ndarray]) -> None:
        self.pools = pools
        self._set_pool_sizes([len(tasks) for tasks in pools])
        chosen = zip(self.task_id.tolist(), self.task_index.tolist(), strict=True)
        self.goal = torch.from_numpy(np.stack([pools[slot][task] for slot, task in chosen])).float()

    def state_dict(self) -> State:
        return super().state_dict() | {"pools": [torch.from_numpy(np.array(tasks)) for tasks in self.pools]}

    def load_state_dict(self, state: State) -> None:
        self._set_pools([tasks.numpy() for tasks in state["pools"]])
        super().load_state_dict(state)

"""Points that look for a hidden goal: a small world with pools of tasks, and agents that adapt in it."""

from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

from bidex_meta.agents import Timestep

SPEED = 0.25


@dataclass(frozen=True)
class Pool:
    name: str
    tasks: np.ndarray
    steps: int


def ring(count: int, turn: float = 0.0) -> np.ndarray:
    """Goals on the unit circle, (count, 2)."""
    angle = turn + 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)], 1)


class PointWorld:
    """Rows are points in the plane that see their place and the time left, not their goal.

    Like ``bidex_meta.World`` in DISABLED mode: rows of a slot are contiguous, row j keeps task j modulo their number,
    an ended row is frozen. Reward: minus the distance to the goal.

    Args:
        num_envs: Rows over all slots.
        pools: Goals of each slot, (n, 2).
        steps: Time limit of each slot.
        ends: Whether an episode ends (terminated) at its goal.
        noise: Half the range of starts around the origin.
        breaks: Rows whose physics breaks in the second step of each episode.
    """

    def __init__(
        self,
        num_envs: int,
        pools: dict[str, np.ndarray],
        steps: tuple[int, ...] = (8, 12),
        *,
        ends: bool = False,
        noise: float = 0.1,
        breaks: tuple[int, ...] = (),
        mode: str = "DISABLED",
        seed: int = 0,
    ):
        self.metadata = {"autoreset_mode": gymnasium.vector.AutoresetMode[mode]}
        self.slots = [Pool(name, goals, steps[i]) for i, (name, goals) in enumerate(pools.items())]
        self.task_names, self.num_tasks, self.num_envs = list(pools), len(pools), num_envs
        self.seed, self.ends, self.noise = seed, ends, noise
        sizes = [len(part) for part in np.array_split(np.arange(num_envs), self.num_tasks)]
        stops = np.cumsum(sizes)
        self.slot_rows = [slice(int(stop - size), int(stop)) for size, stop in zip(sizes, stops, strict=True)]
        self.task_id = torch.repeat_interleave(torch.arange(self.num_tasks), torch.tensor(sizes))
        self._place = torch.cat([torch.arange(size) for size in sizes])
        self.max_episode_steps = torch.tensor([slot.steps for slot in self.slots])[self.task_id]
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1, 1, (num_envs, 2), np.float32)
        self._breaks = torch.isin(torch.arange(num_envs), torch.tensor(breaks, dtype=torch.int64))
        self.episode, self.x = torch.zeros(num_envs, dtype=torch.int64), torch.zeros(num_envs, 2)
        self.elapsed, self.over = torch.zeros(num_envs, dtype=torch.int64), torch.zeros(2, num_envs, dtype=torch.bool)
        self.seeds: list[int | None] = []
        self.starts: list[Tensor] = []
        self.pools: list[dict[str, np.ndarray]] = []
        self._assign_tasks()

    def _assign_tasks(self) -> None:
        self.num_slot_tasks = [len(slot.tasks) for slot in self.slots]
        self.task_index = self._place % torch.tensor(self.num_slot_tasks)[self.task_id]
        rows = zip(self.task_id.tolist(), self.task_index.tolist(), strict=True)
        self.goal = torch.tensor(np.stack([self.slots[i].tasks[j] for i, j in rows]), dtype=torch.float32)
        self.ready = False

    def set_tasks(self, pools: dict[str, np.ndarray]) -> None:
        self.pools.append(pools)
        self.slots = [replace(slot, tasks=pools.get(slot.name, slot.tasks)) for slot in self.slots]
        self._assign_tasks()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        mask = (options or {}).get("reset_mask", torch.ones(self.num_envs, dtype=torch.bool))
        assert self.ready or mask.all()
        self.ready = True
        if seed is not None:
            self.seed, self.episode = seed, torch.zeros_like(self.episode)
        self.seeds.append(seed)
        self.episode = self.episode + mask
        drawn = np.stack(
            [np.random.default_rng((self.seed, i, int(n))).uniform(-1, 1, 2) for i, n in enumerate(self.episode)]
        )
        self.x = torch.where(mask[:, None], self.noise * torch.tensor(drawn, dtype=torch.float32), self.x)
        self.starts.append(self.x[mask].clone())
        self.elapsed, self.over = self.elapsed.masked_fill(mask, 0), self.over & ~mask
        return self._obs(), {}

    def _obs(self) -> Tensor:
        return torch.cat([self.x, (self.max_episode_steps - self.elapsed)[:, None] / 10], 1)

    def step(self, action: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        active = ~self.over.any(0)
        self.elapsed = self.elapsed + active
        unstable = active & self._breaks & (self.elapsed == 2)
        moved = self.x + SPEED * torch.as_tensor(action, dtype=torch.float32).clamp(-1, 1)
        self.x = torch.where((active & ~unstable)[:, None], moved, self.x)
        distance = (self.x - self.goal).norm(dim=1)
        success = (distance < 0.2) & ~unstable
        unscaled = torch.where(active & ~unstable, -distance, 0.0)
        terminated = self.over[0] | (active & success & self.ends)
        truncated = self.over[1] | (active & ((self.elapsed >= self.max_episode_steps) | unstable) & ~terminated)
        self.over = torch.stack([terminated, truncated])
        info = {"success": success, "unstable": unstable, "reward_unscaled": unscaled}
        return self._obs(), 2 * unscaled, terminated.clone(), truncated.clone(), info

    def close(self) -> None:
        """Nothing is held."""


class Still:
    """Does not adapt: one fixed direction; explores by other ones. Keeps what it is told."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.steps: list[Timestep] = []
        self.masks: list[Tensor] = []
        self.of_row = torch.zeros(0, dtype=torch.int64)
        self._generator = torch.Generator().manual_seed(0)

    def _called(self, name: str) -> None:
        if not self.calls or self.calls[-1] != name:
            self.calls.append(name)

    def assign(self, task_of_row: Tensor | None) -> None:
        self._called("assign")
        assert task_of_row is not None
        self.of_row = task_of_row

    def init(self) -> None:
        self._called("init")

    def reset(self, env_mask: Tensor) -> None:
        self._called("reset")
        self.masks.append(env_mask.clone())

    def eval_action(self, obs: Tensor) -> Any:
        self._called("eval_action")
        return torch.full((len(obs), 2), 0.1)

    def adapt_action(self, obs: Tensor) -> tuple[Any, dict[str, Any]]:
        self._called("adapt_action")
        action = 2 * torch.rand(len(obs), 2, generator=self._generator) - 1
        return action, {"double": 2 * action}

    def step(self, timestep: Timestep) -> None:
        self._called("step")
        self.steps.append(timestep)

    def adapt(self) -> None:
        self._called("adapt")


class Finder(Still):
    """Remembers of each task the place with the best reward, and goes there."""

    def assign(self, task_of_row: Tensor | None) -> None:
        self._called("assign")
        self.of_row = torch.zeros(0, dtype=torch.int64) if task_of_row is None else task_of_row

    def init(self) -> None:
        super().init()
        self.steps.clear()
        self.best, self._reward = torch.zeros(0, 2), torch.zeros(0)

    def _know(self, rows: int) -> None:
        if not len(self.of_row):
            self.of_row = torch.arange(rows)
        if not len(self.best):
            self.best = torch.zeros(int(self.of_row.max()) + 1, 2)
            self._reward = torch.full((len(self.best),), -torch.inf)

    def eval_action(self, obs: Tensor) -> Any:
        super().eval_action(obs)
        self._know(len(obs))
        return ((self.best[self.of_row] - obs[:, :2]) / SPEED).clamp(-1, 1)

    def adapt_action(self, obs: Tensor) -> tuple[Any, dict[str, Any]]:
        self._know(len(obs))
        # Rows go different ways, and hold them.
        angle = torch.arange(len(obs)) * 2.399
        drift = torch.stack([angle.cos(), angle.sin()], 1)
        return 0.7 * drift + 0.3 * super().adapt_action(obs)[0], {}

    def adapt(self) -> None:
        super().adapt()
        for told in self.steps:
            # From Meta-World neither comes: there all rows always play.
            valid = torch.ones(len(told.reward), dtype=torch.bool) if told.valid is None else told.valid
            reached = told.observation[:, :2] + SPEED * told.action.clamp(-1, 1)
            for row in valid.nonzero().squeeze(1).tolist():
                task = int(self.of_row[row])
                if told.reward[row] > self._reward[task]:
                    self._reward[task], self.best[task] = told.reward[row], reached[row]
        self.steps.clear()

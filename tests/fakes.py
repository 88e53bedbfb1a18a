"""A small world that keeps the contract of ``bidex_meta.world.World``, without physics."""

from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

SLOT_TASKS = [3, 2]
SLOT_NAMES = ["Near", "Far"]
STEPS_OF_TASK = [4, 9, 6]


class ToyWorld:
    """A point on a line that shall go to its task's goal; the tasks' episodes differ in length.

    Row j of a slot keeps task j modulo the slot's number of tasks. Rewards are scaled by 10 and so differ from
    ``info["reward_unscaled"]``.
    """

    def __init__(self, num_envs: int, mode: str, seed: int = 0, slot_tasks: list[int] | None = None):
        self.num_slot_tasks = slot_tasks or SLOT_TASKS
        self.num_tasks = len(self.num_slot_tasks)
        self.task_names = SLOT_NAMES[: self.num_tasks]
        self.num_envs, self.device, self.seed = num_envs, torch.device("cpu"), seed
        self.autoreset_mode = gymnasium.vector.AutoresetMode[mode]
        self.metadata = {"autoreset_mode": self.autoreset_mode}
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1, 1, (num_envs, 1), np.float32)
        sizes = [len(part) for part in np.array_split(np.arange(num_envs), self.num_tasks)]
        ends = np.cumsum(sizes)
        self.slot_rows = [slice(int(end - size), int(end)) for size, end in zip(sizes, ends, strict=True)]
        self.task_id = torch.repeat_interleave(torch.arange(self.num_tasks), torch.tensor(sizes))
        place = torch.cat([torch.arange(size) for size in sizes])
        self.task_index = place % torch.tensor(self.num_slot_tasks)[self.task_id]
        self.max_episode_steps = torch.tensor(STEPS_OF_TASK)[self.task_index]
        self.goal = (1.0 + self.task_id) * (1.0 + self.task_index) / 4
        self.episode = torch.zeros(num_envs, dtype=torch.int64)
        self.resets = torch.zeros(num_envs, dtype=torch.int64)
        self._restart(torch.ones(num_envs, dtype=torch.bool))

    def _restart(self, mask: Tensor) -> None:
        rows = torch.arange(self.num_envs)
        start = torch.sin(rows * 12.9898 + self.episode * 78.233 + self.seed).mul(0.1)
        if not hasattr(self, "x"):
            self.x, self.elapsed = start.clone(), torch.zeros_like(rows)
            self.sum, self.success = torch.zeros(self.num_envs), torch.zeros(self.num_envs, dtype=torch.bool)
            self.done = torch.zeros(self.num_envs, dtype=torch.bool)
        self.x = torch.where(mask, start, self.x)
        self.elapsed = self.elapsed.masked_fill(mask, 0)
        self.sum = self.sum.masked_fill(mask, 0)
        self.success, self.done = self.success & ~mask, self.done & ~mask
        self.episode, self.resets = self.episode + mask, self.resets + mask

    def _obs(self) -> Tensor:
        return torch.stack([self.x, self.goal], 1)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        mask = (options or {}).get("reset_mask", torch.ones(self.num_envs, dtype=torch.bool))
        if seed is not None:
            self.seed, self.episode = seed, torch.zeros_like(self.episode)
        self._restart(mask)
        return self._obs(), {}

    def step(self, action: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        frozen = self.done.clone()
        moved = self.x + 0.3 * torch.as_tensor(action)[:, 0].clamp(-1, 1)
        self.x = torch.where(frozen, self.x, moved)
        distance = (self.x - self.goal).abs()
        unscaled = torch.where(frozen, 0.0, 1 - distance)
        success = distance < 0.1
        self.elapsed = self.elapsed + ~frozen
        self.sum, self.success = self.sum + unscaled, self.success | (success & ~frozen)
        truncated = self.elapsed >= self.max_episode_steps
        self.done, ended = truncated, truncated & ~frozen
        obs = self._obs()
        info: dict[str, Any] = {
            "success": success,
            "unstable": torch.zeros_like(success),
            "reward_unscaled": unscaled,
            "reward_terms": {"distance": unscaled},
            "final_obs": obs,
            "_final_obs": ended,
            "episode": {"r": self.sum.clone(), "l": self.elapsed.clone(), "success": self.success.clone()},
            "_episode": ended,
        }
        if self.autoreset_mode == gymnasium.vector.AutoresetMode.SAME_STEP:
            self._restart(truncated)
        return self._obs(), 10 * unscaled, torch.zeros_like(truncated), truncated, info

    def state_dict(self) -> dict[str, Any]:
        return {name: getattr(self, name).clone() for name in ("x", "elapsed", "sum", "success", "done", "episode")} | {
            "seed": self.seed
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            setattr(self, name, value)

    def render(self, row: int = 0, width: int = 640, height: int = 480, camera: str | None = None) -> np.ndarray:
        frame = np.zeros((height, width, 3), np.uint8)
        frame[:, int(self.elapsed[row]) :, row % 3] = 255
        return frame

    def close(self) -> None:
        """Nothing is held."""


class Seeker:
    """Walks towards the goal: solves every task of ToyWorld it has the time for."""

    def __init__(self) -> None:
        self.masks: list[Tensor] = []

    def eval_action(self, obs: Tensor) -> Tensor:
        return ((obs[:, 1] - obs[:, 0]) / 0.3).clamp(-1, 1)[:, None]

    def reset(self, env_mask: Tensor) -> None:
        self.masks.append(env_mask.clone())

"""Small worlds for the learners' tests: a batched bandit whose episodes end at a step count, reset within the step."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from tests.fake_world import FakeWorld


def nearness(target: float, scale: float = 1.0) -> Callable[[Tensor], Tensor]:
    return lambda action: scale * (1.0 - (action - target).square().mean(-1))


class ToyWorld(FakeWorld):
    """Bandits, ``rows`` a task; observations are a noise column and the one-hot, but not the clock.

    ``rewards``: of each task, of clamped actions (rows, a); ``terminal``: whether episodes end truly at ``horizon``;
    ``unstable``: (step, row) where physics breaks; ``garbage``: what reward and final observation hold there.
    """

    def __init__(
        self, rewards: list[Callable[[Tensor], Tensor]], rows: int = 32, horizon: int = 4, terminal: bool = False,
        actions: int = 2, unstable: tuple[tuple[int, int], ...] = (), garbage: float = 0.0
    ):  # fmt: skip
        self.rewards, self.terminal, self.garbage = rewards, terminal, garbage
        names, rows = {f"task{i}": 1 for i in range(len(rewards))}, rows * len(rewards)
        sizes, limits = (1 + len(rewards), actions), (horizon,) * len(rewards)
        super().__init__(names, rows, sizes, limits, one_hot=True, unstable=unstable)

    def _first_elapsed(self) -> Tensor:
        return torch.arange(self.num_envs) % self.max_episode_steps

    def _start(self, mask: Tensor) -> None:
        """Bandits have no state."""

    def _observe(self) -> Tensor:
        noise = torch.randn(self.num_envs, 1, generator=self.generator)
        one_hot = torch.nn.functional.one_hot(self.task_id, self.num_tasks).float()
        return torch.cat([noise, one_hot], dim=1)

    def _advance(self, action: Tensor, active: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        # Rows of one task are contiguous, so concatenation keeps their order.
        reward = torch.cat([f(action[rows]) for f, rows in zip(self.rewards, self.slot_env_ids, strict=True)])
        over = self.episodes.elapsed + 1 >= self.max_episode_steps
        return reward, reward > 0.9, over & self.terminal

    def step(self, action: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        obs, reward, terminated, truncated, info = super().step(action)
        if self.garbage:
            reward[info["unstable"]] = info["final_obs"][info["unstable"]] = self.garbage
        return obs, reward, terminated, truncated, info

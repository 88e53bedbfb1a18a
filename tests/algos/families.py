"""Families of tasks to adapt to, with the contract of ``bidex_meta.world.World`` in mode DISABLED."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bidex_meta.agents import MetaLearningAgent, Timestep
from bidex_meta.world.random import env_keys, uniform
from tests.fake_world import FakePools


def circle(count: int, first: float = 0.0, radius: float = 1.0) -> np.ndarray:
    """Goals evenly on a circle about the origin, the first of them at the angle ``first`` (radians): (count, 2)."""
    angle = first + 2.0 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


@dataclass(frozen=True)
class PointClass:
    """A task class of :class:`PointGoals`."""

    name: str = "PointGoals"
    steps: int = 20  # time limit in steps
    scale: float = 1.0  # scale of the reward
    count: int = 8  # number of goals in the pool, on a :func:`circle`


class PointGoals(FakePools):
    """A point in the plane moves by ``speed`` times the action; reward minus its distance to the row's goal.

    Row j of a class has goal j modulo the pool's size. Episodes start within 0.1 of the origin, by seed, class, row and
    episode alone. Observations are the position and the goal (N, 4), zeros unless visible. Success: within 0.1 of it.
    One that cannot know the goal does best to stay: about -1 a step. ``rows`` are split evenly over the classes;
    ``end_at_goal``: a true end; ``unstable``: (step, row) where physics breaks; ``garbage``: the reward there.
    """

    speed = 0.2
    kept = ("position",)
    hidden_size = 2
    goal_entries = torch.tensor([2, 3])

    def __init__(
        self, rows: int = 40, goal_visible: bool = False, classes: Sequence[PointClass] = (PointClass(),),
        seed: int = 0, autoreset_mode: str = "DISABLED", end_at_goal: bool = False,
        unstable: tuple[tuple[int, int], ...] = (), garbage: float = 0.0
    ):  # fmt: skip
        self.goal_visible, self.end_at_goal, self.garbage = goal_visible, end_at_goal, garbage
        pools, limits = {c.name: circle(c.count) for c in classes}, tuple(c.steps for c in classes)
        super().__init__(pools, rows, (4, 2), limits, autoreset_mode, seed=seed, unstable=unstable)
        self._scale = torch.tensor([c.scale for c in classes])[self.task_id]
        self.position = torch.zeros(rows, 2)

    def _seed_rows(self, seed: int) -> None:
        super()._seed_rows(seed)
        pairs = zip(self.task_names, self.slot_env_ids, strict=True)
        self._keys = torch.cat([env_keys(seed, name, r.stop - r.start, self.device) for name, r in pairs])

    def _start(self, mask: Tensor) -> None:
        start = 0.2 * uniform(self._keys, self.episodes.number, 2).float() - 0.1
        self.position = torch.where(mask[:, None], start, self.position)

    def _observe(self) -> Tensor:
        return torch.cat([self.position, self.goal * float(self.goal_visible)], dim=1)

    def _advance(self, action: Tensor, active: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        moved = (self.position + self.speed * action).clamp(-2.0, 2.0)
        self.position = torch.where(active[:, None], moved, self.position)
        distance = (self.position - self.goal).norm(dim=1)
        success = distance < 0.1
        return -distance, success, success & self.end_at_goal

    def _scaled(self, unscaled: Tensor) -> Tensor:
        return unscaled * self._scale

    def step(self, action: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        obs, reward, terminated, truncated, info = super().step(action)
        if self.garbage:
            reward[info["unstable"]] = self.garbage
        return obs, reward, terminated, truncated, info

    def best(self, obs: Tensor) -> Tensor:
        return ((obs[:, 2:] - obs[:, :2]) / self.speed).clamp(-1.0, 1.0)


class EndlessGoals(PointGoals):
    """Point goals without number: set ``number`` lies on a circle that begins at an angle of ``number`` radians."""

    endless = True

    def fresh_tasks(self, number: int, count: int) -> dict[str, np.ndarray]:
        return {name: circle(count, first=float(number), radius=1.0 + i) for i, name in enumerate(self.task_names)}


def everyone(world: Any) -> Tensor:
    return torch.ones(world.num_envs, dtype=torch.bool)


def played(act: Callable[[Tensor], Tensor], world: PointGoals, seed: int | None = None) -> float:
    """Mean return of an episode of each row."""
    obs, _ = world.reset(seed=seed)
    total = 0.0
    for _ in range(int(world.max_episode_steps.max())):
        obs, reward, *_ = world.step(act(obs))
        total += float(reward.mean())
    return total


def shot(agent: MetaLearningAgent, world: PointGoals, seed: int | None = None) -> None:
    """An episode in each row, and the adaptation by it."""
    obs, _ = world.reset(seed=seed)
    agent.reset(everyone(world))
    over = ~everyone(world)
    for _ in range(int(world.max_episode_steps.max())):
        action, aux = agent.adapt_action(obs)
        following, reward, terminated, truncated, _ = world.step(action)
        agent.step(Timestep(obs, action, reward, terminated, truncated, aux, following, ~over))
        obs, over = following, terminated | truncated
    agent.adapt()


class Passing(PointGoals):
    """Points whose success counts at the end and depends on the clock alone, in episodes of 20 steps.

    Environments 0, 4, 8, ... hold the goal from step 5 to the end. The others hold it for 16 steps, from step 2 on, and
    lose it.
    """

    success_at_end = True

    def __init__(self, rows: int = 16, autoreset_mode: str = "DISABLED"):
        super().__init__(rows, classes=(PointClass(steps=20, count=4),), autoreset_mode=autoreset_mode)

    def _advance(self, action: Tensor, active: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        reward, _, failed = super()._advance(action, active)
        elapsed = self.episodes.elapsed
        passing = (elapsed >= 1) & (elapsed < 17)
        return reward, torch.where(torch.arange(self.num_envs) % 4 == 0, elapsed >= 4, passing), failed


class Recall(FakePools):
    """Two tasks, 1 and -1. The first reward of an episode is the task, the last one is paid for an action of its sign.

    Observations show the last step (N, 1). Without memory of the first reward half of the episodes succeed, else all.
    """

    def __init__(self, rows: int = 32, steps: int = 60):
        super().__init__({"Recall": np.array([[1.0, 0.0], [-1.0, 0.0]])}, rows, (1, 1), (steps,), "DISABLED")

    def _start(self, mask: Tensor) -> None:
        """There is no state but the clock."""

    def _at_end(self) -> Tensor:
        return self.episodes.elapsed == self.max_episode_steps - 1

    def _observe(self) -> Tensor:
        return self._at_end()[:, None].float()

    def _advance(self, action: Tensor, active: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        sign, last = self.goal[:, 0], self._at_end()
        earned = sign * torch.where(last, action[:, 0], (self.episodes.elapsed == 0).float())
        return earned, last & (earned > 0.0), torch.zeros_like(last)


class Slopes(FakePools):
    """A step is paid g a - a²/2 for its action a, where g is the task's, evenly from -1 to 1; nothing is seen.

    The best action is g, for g²/2; the best of all that do not know it is 0, for nothing.
    """

    def __init__(self, rows: int = 16, mode: str = "DISABLED", tasks: int = 16, steps: int = 5):
        slopes = np.linspace(-1.0, 1.0, tasks)
        super().__init__({"Slopes": np.stack([slopes, slopes], axis=1)}, rows, (1, 1), (steps,), mode)

    def _start(self, mask: Tensor) -> None:
        """There is no state."""

    def _observe(self) -> Tensor:
        return torch.zeros(self.num_envs, 1)

    def _advance(self, action: Tensor, active: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        slope, a = self.goal[:, 0], action[:, 0]
        return slope * a - 0.5 * a.square(), (a - slope).abs() < 0.1, torch.zeros_like(active)

    def best(self) -> float:
        """Highest mean return of an episode."""
        return float((0.5 * self.goal[:, 0].square() * self.max_episode_steps).mean())

"""Toy worlds whose optimum is known, for the tests of all learners: bandits, LQR and a point mass."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from tests.algos.toy import ToyWorld, nearness


def one_step_bandit(target: float = 0.6, rows: int = 32) -> ToyWorld:
    """Episodes of one step that end truly. The best action is ``target`` in each entry and pays 1."""
    return ToyWorld([nearness(target)], rows=rows, horizon=1, terminal=True)


def opposite_bandits(target: float = 0.5, scale: float = 1.0, rows: int = 32) -> ToyWorld:
    """Two tasks with best actions ``target`` and ``-target``; the second pays ``scale`` times as much.

    Without the one-hot they look alike, and the best for both together with ``scale`` 1 is 0.
    """
    return ToyWorld([nearness(target), nearness(-target, scale)], rows=rows)


class _TimedWorld(ABC):
    """What LQR and PointMass share: one task, episodes that a time limit alone ends, reset within the step.

    Rows begin at different times of their first episode. A subclass gives ``_start`` (states of new episodes (N, s)),
    ``_observe`` (observations (N, d)) and ``_advance`` (takes clamped actions, moves ``self.state``, returns rewards
    and successes (N,)).
    """

    def __init__(self, observations: int, actions: int, rows: int, horizon: int):
        self.num_envs, self.horizon = rows, horizon
        self.num_tasks, self.num_id_columns = 1, 0
        self.device = torch.device("cpu")
        self.task_id = torch.zeros(rows, dtype=torch.int64)
        self.task_names = [type(self).__name__]
        self.single_observation_space: Any = SimpleNamespace(shape=(observations,))
        self.single_action_space: Any = SimpleNamespace(shape=(actions,))
        self.generator = torch.Generator()
        self.state = torch.empty(0)
        self.elapsed = torch.arange(rows) % horizon
        self.returns = torch.zeros(rows)

    @abstractmethod
    def _start(self) -> Tensor: ...

    @abstractmethod
    def _observe(self) -> Tensor: ...

    @abstractmethod
    def _advance(self, action: Tensor) -> tuple[Tensor, Tensor]: ...

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        self.generator.manual_seed(seed or 0)
        self.state = self._start()
        self.elapsed, self.returns = torch.arange(self.num_envs) % self.horizon, torch.zeros(self.num_envs)
        return self._observe(), {}

    def step(self, actions: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        reward, success = self._advance(torch.as_tensor(actions).clamp(-1.0, 1.0))
        self.elapsed, self.returns = self.elapsed + 1, self.returns + reward
        over, never = self.elapsed >= self.horizon, torch.zeros(self.num_envs, dtype=torch.bool)
        final_obs = self._observe()
        episode = {"r": self.returns, "l": self.elapsed, "success": success}
        info = {"unstable": never, "final_obs": final_obs, "_final_obs": over, "episode": episode, "_episode": over}
        self.state = torch.where(over[:, None], self._start(), self.state)
        self.elapsed, self.returns = self.elapsed.masked_fill(over, 0), self.returns.masked_fill(over, 0.0)
        return self._observe(), reward, never, over, info

    def state_dict(self) -> dict[str, Any]:
        tensors = {"state": self.state, "elapsed": self.elapsed, "returns": self.returns}
        return {name: x.clone() for name, x in tensors.items()} | {"generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.state, self.elapsed, self.returns = (state[name].clone() for name in ("state", "elapsed", "returns"))
        self.generator.set_state(state["generator"])


class LQR(_TimedWorld):
    """A state of two turns by 0.3 rad and shrinks by 5 % a step, two actions push it; reward -(x·x + 0.1 u·u).

    Starts are uniform in [-0.5, 0.5]; from there the best actions stay within [-1, 1].
    """

    def __init__(self, rows: int = 32, horizon: int = 25):
        super().__init__(2, 2, rows, horizon)
        cos, sin = np.cos(0.3), np.sin(0.3)
        self.a, self.b = 0.95 * np.array([[cos, -sin], [sin, cos]]), 0.5 * np.eye(2)
        self.q, self.r = np.eye(2), 0.1 * np.eye(2)

    def _start(self) -> Tensor:
        return torch.rand(self.num_envs, 2, generator=self.generator) - 0.5

    def _observe(self) -> Tensor:
        return self.state.clone()

    def _advance(self, action: Tensor) -> tuple[Tensor, Tensor]:
        a, b, q, r = (torch.from_numpy(m).float() for m in (self.a, self.b, self.q, self.r))
        cost = ((self.state @ q) * self.state).sum(1) + ((action @ r) * action).sum(1)
        # A policy that blows the state up shall be bad, not infinite.
        self.state = (self.state @ a.T + action @ b.T).clamp(-5.0, 5.0)
        return -cost, self.state.abs().amax(1) < 0.1

    def optimum(self, gamma: float) -> tuple[np.ndarray, np.ndarray]:
        """P and K: the best discounted return from x is -x·Px, by the actions -Kx."""
        a, b = np.sqrt(gamma) * self.a, np.sqrt(gamma) * self.b
        p = scipy.linalg.solve_discrete_are(a, b, self.q, self.r)
        return p, np.linalg.solve(self.r + b.T @ p @ b, b.T @ p @ a)

    def best(self, gamma: float) -> Callable[[Tensor], Tensor]:
        """The best policy, observations to actions."""
        k = torch.from_numpy(self.optimum(gamma)[1]).float()
        return lambda obs: -obs @ k.T


class PointMass(_TimedWorld):
    """A point in the plane moves by 0.1 times the action; reward minus its distance to the goal, drawn for the episode.

    Position and goal are uniform in [-0.5, 0.5]. The best action goes towards the goal in each coordinate at once, as
    far as it can, whatever the discount. Success: within 0.05 at the end.

    Args:
        rows: Rows.
        horizon: Steps per episode.
        goal_visible: Whether the observation (position, goal) shows the goal or zeros.
    """

    speed = 0.1

    def __init__(self, rows: int = 32, horizon: int = 20, goal_visible: bool = True):
        super().__init__(4, 2, rows, horizon)
        self.goal_visible = goal_visible

    def _start(self) -> Tensor:
        return torch.rand(self.num_envs, 4, generator=self.generator) - 0.5

    def _observe(self) -> Tensor:
        shown = self.state.clone()
        shown[:, 2:] *= float(self.goal_visible)
        return shown

    def _advance(self, action: Tensor) -> tuple[Tensor, Tensor]:
        position, goal = self.state[:, :2] + self.speed * action, self.state[:, 2:]
        self.state = torch.cat([position.clamp(-1.0, 1.0), goal], dim=1)
        distance = (self.state[:, :2] - goal).norm(dim=1)
        return -distance, distance < 0.05

    def best(self, obs: Tensor) -> Tensor:
        """The best action (N, 2) for observations that show the goal."""
        return ((obs[:, 2:] - obs[:, :2]) / self.speed).clamp(-1.0, 1.0)


def discounted_return(world: LQR | PointMass, policy: Callable[[Tensor], Tensor], gamma: float, steps: int) -> float:
    """Mean over rows of the discounted return of ``policy`` from the starts of seed 1; no episode ends.

    Leaves ``world`` somewhere else: call it with one that nobody trains on.
    """
    world.horizon = 10**9
    obs, _ = world.reset(seed=1)
    total = torch.zeros(world.num_envs)
    for t in range(steps):
        obs, reward, *_ = world.step(policy(obs))
        total += gamma**t * reward
    return float(total.mean())

"""Toy worlds whose optimum is known, for the tests of all learners: bandits, LQR and a point mass."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from bidex_algos.replay import Transitions
from tests.algos.toy import ToyWorld, nearness
from tests.fake_world import FakeWorld

OFF_POLICY: dict[str, Any] = {
    "hidden": (32, 32), "replay_steps": 200, "cut_share": 0.3, "warmup_steps": 4, "batch_size": 128, "gamma": 0.8,
    "tau": 0.05, "learning_rate": 3e-3, "critic_learning_rate": 5e-3, "autocast": "off",
}  # fmt: skip


def one_step_bandit(target: float = 0.6, rows: int = 32) -> ToyWorld:
    return ToyWorld([nearness(target)], rows=rows, horizon=1, terminal=True)


def opposite_bandits(target: float = 0.5, scale: float = 1.0, rows: int = 32) -> ToyWorld:
    """Two tasks with best actions ``target`` and ``-target``; the second pays ``scale`` times as much.

    Without the one-hot they look alike, and the best for both together with ``scale`` 1 is 0.
    """
    return ToyWorld([nearness(target), nearness(-target, scale)], rows=rows)


class _TimedWorld(FakeWorld):
    """One task, episodes that a time limit alone ends; rows begin at different times of their first one."""

    kept = ("state",)

    def __init__(self, observations: int, actions: int, rows: int, horizon: int):
        super().__init__({type(self).__name__: 1}, rows, (observations, actions), (horizon,))
        self.state = torch.zeros(rows, observations)
        self.never = torch.zeros(rows, dtype=torch.bool)

    def _first_elapsed(self) -> Tensor:
        return torch.arange(self.num_envs) % self.max_episode_steps

    @abstractmethod
    def _draw(self) -> Tensor: ...

    def _observe(self) -> Tensor:
        return self.state.clone()

    def _start(self, mask: Tensor) -> None:
        self.state = torch.where(mask[:, None], self._draw(), self.state)


class LQR(_TimedWorld):
    """A state of two turns by 0.3 rad and shrinks by 5 % a step, two actions push it; reward -(x·x + 0.1 u·u).

    Starts are uniform in [-0.5, 0.5]; from there the best actions stay within [-1, 1].
    """

    def __init__(self, rows: int = 32, horizon: int = 25):
        super().__init__(2, 2, rows, horizon)
        cos, sin = np.cos(0.3), np.sin(0.3)
        self.a, self.b = 0.95 * np.array([[cos, -sin], [sin, cos]]), 0.5 * np.eye(2)
        self.q, self.r = np.eye(2), 0.1 * np.eye(2)

    def _draw(self) -> Tensor:
        return torch.rand(self.num_envs, 2, generator=self.generator) - 0.5

    def _advance(self, action: Tensor, active: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        a, b, q, r = (torch.from_numpy(m).float() for m in (self.a, self.b, self.q, self.r))
        cost = ((self.state @ q) * self.state).sum(1) + ((action @ r) * action).sum(1)
        # A policy that lets the state diverge must be rated as bad, not as infinite.
        state = (self.state @ a.T + action @ b.T).clamp(-5.0, 5.0)
        self.state = torch.where(active[:, None], state, self.state)
        return -cost, self.state.abs().amax(1) < 0.1, self.never

    def optimum(self, gamma: float) -> tuple[np.ndarray, np.ndarray]:
        a, b = np.sqrt(gamma) * self.a, np.sqrt(gamma) * self.b
        p = scipy.linalg.solve_discrete_are(a, b, self.q, self.r)
        return p, np.linalg.solve(self.r + b.T @ p @ b, b.T @ p @ a)

    def best(self, gamma: float) -> Callable[[Tensor], Tensor]:
        k = torch.from_numpy(self.optimum(gamma)[1]).float()
        return lambda obs: -obs @ k.T


class PointMass(_TimedWorld):
    """A point in the plane moves by 0.1 times the action; reward minus its distance to the goal, drawn for the episode.

    Position and goal are uniform in [-0.5, 0.5]; the best action goes to the goal in each coordinate as far as it can.
    """

    speed = 0.1

    def __init__(self, rows: int = 32, horizon: int = 20):
        super().__init__(4, 2, rows, horizon)

    def _draw(self) -> Tensor:
        return torch.rand(self.num_envs, 4, generator=self.generator) - 0.5

    def _advance(self, action: Tensor, active: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        position, goal = self.state[:, :2] + self.speed * action, self.state[:, 2:]
        self.state = torch.where(active[:, None], torch.cat([position.clamp(-1.0, 1.0), goal], dim=1), self.state)
        distance = (self.state[:, :2] - goal).norm(dim=1)
        return -distance, distance < 0.05, self.never

    def best(self, obs: Tensor) -> Tensor:
        return ((obs[:, 2:] - obs[:, :2]) / self.speed).clamp(-1.0, 1.0)


class Track(_TimedWorld):
    """A point beside a winding track drifts away from it by a fifth a step; observations are place and position.

    The teacher, which starts on the track, never leaves it: its data do not show how to get back. Success: within 0.1
    of the track.
    """

    drift, pull = 1.2, 0.2

    def __init__(self, rows: int = 32, horizon: int = 60):
        super().__init__(3, 1, rows, horizon)

    def _draw(self) -> Tensor:
        angle = 2.0 * torch.pi * torch.rand(self.num_envs, generator=self.generator)
        return torch.stack([angle.sin(), angle.cos(), 0.5 * angle.sin()], 1)

    def off(self) -> Tensor:
        return self.state[:, 2] - 0.5 * self.state[:, 0]

    def best(self, obs: Tensor) -> Tensor:
        off = obs[:, 2] - 0.5 * obs[:, 0]
        return (0.5 * obs[:, 1] - self.drift / self.pull * off)[:, None].clamp(-1.0, 1.0)

    def _advance(self, action: Tensor, active: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        off = self.drift * self.off() + self.pull * (action[:, 0] - 0.5 * self.state[:, 1])
        angle = torch.atan2(self.state[:, 0], self.state[:, 1]) + 0.1
        state = torch.stack([angle.sin(), angle.cos(), 0.5 * angle.sin() + off.clamp(-2.0, 2.0)], 1)
        self.state = torch.where(active[:, None], state, self.state)
        return -self.off().abs(), self.off().abs() < 0.1, self.never


def discounted_return(world: LQR | PointMass, policy: Callable[[Tensor], Tensor], gamma: float, steps: int) -> float:
    """Mean discounted return of ``policy`` from the starts of seed 1, in a world that nobody trains on: none ends."""
    world.max_episode_steps.fill_(10**9)
    obs, _ = world.reset(seed=1)
    total = torch.zeros(world.num_envs)
    for t in range(steps):
        obs, reward, *_ = world.step(policy(obs))
        total += gamma**t * reward
    return float(total.mean())


def is_near_the_optimum(act: Callable[[Tensor], Tensor], gamma: float, factor: float) -> bool:
    """Whether it loses less than ``factor`` times what the Riccati controller does in the LQR."""
    test = LQR(rows=256)
    best = discounted_return(test, test.best(gamma), gamma, 40)
    assert discounted_return(test, lambda obs: torch.zeros(len(obs), 2), gamma, 40) < 2.5 * best
    return discounted_return(test, act, gamma, 40) > factor * best


def a_draw(least: float = 1.0, steps: Sequence[int] = (1,) * 6) -> Transitions:
    """Six transitions of observations (3,) and two actions, of which the second and the fifth end."""
    obs, following = torch.randn(2, 6, 3, generator=torch.Generator().manual_seed(1))
    ends = torch.tensor([False, True, False, False, True, False])
    return Transitions(obs, torch.zeros(6, 2), torch.arange(6.0) + least, following, ends, torch.tensor(steps))


def shake(*nets: torch.nn.Module, by: float = 0.3) -> None:
    noise = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for weight in (weight for net in nets for weight in net.parameters()):
            weight.add_(by * torch.randn(weight.shape, generator=noise))


def trained(kind: Any, world: Any, config: Any, iterations: int) -> Any:
    learner = kind(world, config, seed=0)
    for _ in range(iterations):
        learner.iterate()
    return learner


def errors(learner: Any, *targets: float) -> list[float]:
    obs, _ = learner.world.reset(seed=1)
    action = learner.eval_action(obs)
    return [float((action[learner.world.task_id == k] - target).abs().mean()) for k, target in enumerate(targets)]

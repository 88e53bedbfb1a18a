"""Points that look for a hidden goal: a small world with pools of tasks, and agents that adapt in it."""

import numpy as np
import torch
from torch import Tensor

from bidex_meta.agents import Timestep
from bidex_meta.world.contract import Info, Options
from tests.fake_world import FakePools

SPEED = 0.25


def ring(count: int, turn: float = 0.0) -> np.ndarray:
    """Goals on the unit circle, (count, 2)."""
    angle = turn + 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)], 1)


class PointWorld(FakePools):
    """Rows are points in the plane that see their place and the time left, not their goal, (n, 2) of each slot.

    Reward: minus the distance to the goal, by two. With ``ends`` an episode ends (terminated) at its goal; ``noise`` is
    half the range of starts around the origin; in rows ``breaks`` the second step of each episode breaks the physics.
    """

    kept = ("x",)

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
        super().__init__(pools, num_envs, (3, 2), steps[: len(pools)], mode, seed=seed)
        self.ends, self.noise, self.x = ends, noise, torch.zeros(num_envs, 2)
        self._breaks = torch.isin(torch.arange(num_envs), torch.tensor(breaks, dtype=torch.int64))
        self.seeds: list[int | None] = []  # of each reset
        self.starts: list[Tensor] = []  # places of the rows that each reset started
        self.given: list[dict[str, np.ndarray]] = []  # to each ``set_tasks``

    def set_tasks(self, pools: dict[str, np.ndarray]) -> None:
        self.given.append(pools)
        super().set_tasks(pools)

    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[Tensor, Info]:
        self.seeds.append(seed)
        before = self.episodes.number
        obs, info = super().reset(seed=seed, options=options)
        started = (self.episodes.number != before) | (seed is not None)
        self.starts.append(self.x[started].clone())
        return obs, info

    def _start(self, mask: Tensor) -> None:
        keys = [(self.seed, i, int(n)) for i, n in enumerate(self.episodes.number + 1)]
        drawn = np.stack([np.random.default_rng(key).uniform(-1, 1, 2) for key in keys])
        self.x = torch.where(mask[:, None], self.noise * torch.tensor(drawn, dtype=torch.float32), self.x)

    def _observe(self) -> Tensor:
        return torch.cat([self.x, (self.max_episode_steps - self.episodes.elapsed)[:, None] / 10], 1)

    def _broken(self) -> Tensor:
        return self._breaks & (self.episodes.elapsed == 1)

    def _advance(self, action: Tensor, active: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        self.x = torch.where(active[:, None], self.x + SPEED * action, self.x)
        distance = (self.x - self.goal).norm(dim=1)
        success = distance < 0.2
        return -distance, success, success & self.ends

    def _scaled(self, unscaled: Tensor) -> Tensor:
        return 2 * unscaled


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

    def eval_action(self, obs: Tensor) -> Tensor:
        self._called("eval_action")
        return torch.full((len(obs), 2), 0.1)

    def adapt_action(self, obs: Tensor) -> tuple[Tensor, Info]:
        self._called("adapt_action")
        action = 2 * torch.rand(len(obs), 2, generator=self._generator) - 1
        return action, {"double": 2 * action}

    def step(self, timestep: Timestep) -> None:
        self._called("step")
        self.steps.append(timestep)

    def adapt(self) -> None:
        self._called("adapt")


class Climber:
    """Keeps its direction while its reward rises, and turns when the reward falls: it learns while it acts."""

    def __init__(self) -> None:
        self.observed = 0
        self.angle, self._last = torch.zeros(0), torch.zeros(0)

    def reset(self, env_mask: Tensor) -> None:
        if len(self.angle) != len(env_mask):
            self.angle, self._last = torch.zeros(2, len(env_mask)).unbind()
        self.angle = self.angle.masked_fill(env_mask, 0.0)
        self._last = self._last.masked_fill(env_mask, -torch.inf)

    def act(self, obs: Tensor) -> Tensor:
        return torch.stack([self.angle.cos(), self.angle.sin()], 1)

    def observe(self, timestep: Timestep) -> None:
        assert timestep.valid is not None
        self.observed += 1
        falls = timestep.valid & (timestep.reward < self._last)
        self.angle = self.angle + 2.0 * falls
        self._last = torch.where(timestep.valid, timestep.reward, self._last)


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

    def eval_action(self, obs: Tensor) -> Tensor:
        super().eval_action(obs)
        self._know(len(obs))
        return ((self.best[self.of_row] - obs[:, :2]) / SPEED).clamp(-1, 1)

    def adapt_action(self, obs: Tensor) -> tuple[Tensor, Info]:
        self._know(len(obs))
        # Rows move in different directions and keep these.
        angle = torch.arange(len(obs)) * 2.399
        drift = torch.stack([angle.cos(), angle.sin()], 1)
        return 0.7 * drift + 0.3 * super().adapt_action(obs)[0], {}

    def adapt(self) -> None:
        super().adapt()
        for told in self.steps:
            # Meta-World passes neither, because all its rows always play.
            valid = torch.ones(len(told.reward), dtype=torch.bool) if told.valid is None else told.valid
            reached = told.observation[:, :2] + SPEED * told.action.clamp(-1, 1)
            for row in valid.nonzero().squeeze(1).tolist():
                task = int(self.of_row[row])
                if told.reward[row] > self._reward[task]:
                    self._reward[task], self.best[task] = told.reward[row], reached[row]
        self.steps.clear()

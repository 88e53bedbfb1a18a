"""Small worlds for the learners' tests: a batched bandit whose episodes end at a step count, reset within the step."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor


def nearness(target: float, scale: float = 1.0) -> Callable[[Tensor], Tensor]:
    """Reward scale * (1 - mean squared distance of the clamped action from ``target``)."""
    return lambda action: scale * (1.0 - (action - target).square().mean(-1))


class ToyWorld:
    """Rows of several bandits; observations are a noise column and the one-hot.

    The clock is not observed, so the last state of an episode looks like any other.

    Args:
        rewards: One function a task, of the clamped actions (rows, a) to rewards (rows,).
        rows: Rows per task.
        horizon: Steps per episode.
        terminal: Whether the end of an episode is a true end instead of a time limit.
        actions: Number of actions.
        unstable: (step, row) pairs where physics breaks, counted from the first step.
        garbage: What reward and final observation hold there.
    """

    def __init__(
        self,
        rewards: list[Callable[[Tensor], Tensor]],
        rows: int = 32,
        horizon: int = 4,
        terminal: bool = False,
        actions: int = 2,
        unstable: tuple[tuple[int, int], ...] = (),
        garbage: float = 0.0,
    ):
        self.rewards, self.horizon, self.terminal = rewards, horizon, terminal
        self.unstable, self.garbage = unstable, garbage
        self.num_tasks = self.num_id_columns = len(rewards)
        self.num_envs = rows * self.num_tasks
        self.device = torch.device("cpu")
        self.task_id = torch.arange(self.num_tasks).repeat_interleave(rows)
        self.task_names = [f"task{i}" for i in range(self.num_tasks)]
        self.single_observation_space: Any = SimpleNamespace(shape=(1 + self.num_tasks,))
        self.single_action_space: Any = SimpleNamespace(shape=(actions,))
        self.generator = torch.Generator()
        self.steps = 0

    def _observe(self) -> Tensor:
        noise = torch.randn(self.num_envs, 1, generator=self.generator)
        one_hot = torch.nn.functional.one_hot(self.task_id, self.num_tasks).float()
        return torch.cat([noise, one_hot], dim=1)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        self.generator.manual_seed(seed or 0)
        self.elapsed = torch.arange(self.num_envs) % self.horizon
        self.returns = torch.zeros(self.num_envs)
        return self._observe(), {}

    def step(self, actions: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        action = actions.clamp(-1.0, 1.0)
        # Rows of one task are contiguous, so concatenation keeps their order.
        reward = torch.cat([f(action[self.task_id == k]) for k, f in enumerate(self.rewards)])
        broken = torch.zeros(self.num_envs, dtype=torch.bool)
        broken[[row for step, row in self.unstable if step == self.steps]] = True
        self.steps += 1
        self.elapsed, self.returns = self.elapsed + 1, self.returns + reward
        over = self.elapsed >= self.horizon
        ended = over | broken
        terminated = over & ~broken if self.terminal else torch.zeros_like(over)
        final_obs = torch.where(broken[:, None], self.garbage, self._observe())
        length = self.elapsed
        episode = {"r": self.returns, "l": length, "success": self.returns / length > 0.9}
        info = {"unstable": broken, "final_obs": final_obs, "_final_obs": ended, "episode": episode, "_episode": over}
        self.elapsed = self.elapsed.masked_fill(ended, 0)
        self.returns = self.returns.masked_fill(ended, 0.0)
        reward = torch.where(broken, self.garbage, reward)
        return self._observe(), reward, terminated, ended & ~terminated, info

    def state_dict(self) -> dict[str, Any]:
        return {
            "elapsed": self.elapsed.clone(),
            "returns": self.returns.clone(),
            "generator": self.generator.get_state(),
            "steps": self.steps,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.elapsed, self.returns = state["elapsed"].clone(), state["returns"].clone()
        self.generator.set_state(state["generator"])
        self.steps = state["steps"]

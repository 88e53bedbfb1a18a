"""A family of tasks to adapt to: 2-D point goals, with the contract of ``bidex_meta.world.World`` in mode DISABLED."""

from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from torch import Tensor

from bidex_meta.errors import BidexError
from bidex_meta.world.autoreset import checked_mode, reset_mask
from bidex_meta.world.episodes import Episodes
from bidex_meta.world.random import row_keys, uniform


def circle(count: int, first: float = 0.0, radius: float = 1.0) -> np.ndarray:
    """Goals evenly on a circle about the origin, the first of them at the angle ``first`` (radians): (count, 2)."""
    angle = first + 2.0 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


@dataclass(frozen=True)
class PointClass:
    """A task class of :class:`PointGoals`."""

    name: str = "PointGoals"
    steps: int = 20
    """Time limit."""
    scale: float = 1.0
    """Factor of the reward."""
    count: int = 8
    """Goals in the pool, :func:`circle` of them."""


class PointGoals:
    """A point in the plane moves by ``speed`` times the action; reward minus its distance to the row's goal.

    A goal holds until ``set_tasks``: row j of a class has goal j modulo the pool's size, over all its episodes.
    Episodes start within 0.1 of the origin, drawn by seed, class, row and episode alone, and end by the time limit.
    Observations are the position and the goal, (N, 4), the goal masked by zeros unless visible. Success: within 0.1
    of the goal. As in the real world a finished row is frozen in mode DISABLED, keeps its flags and earns 0 until it
    is reset.

    The best policy goes to the goal in each coordinate at once (:meth:`best`). One that cannot know the goal does
    best to stay where it is: about -1 a step.

    Args:
        rows: Rows over all classes, split evenly.
        goal_visible: Whether the observation shows the goal.
        classes: The task classes.
        seed: Of the starts.
        autoreset_mode: DISABLED or SAME_STEP.
        end_at_goal: Whether reaching the goal ends an episode truly.
        unstable: (step, row) pairs where physics breaks, steps of the world counted from its making.
        garbage: What the reward holds there.
    """

    speed = 0.2
    variation_size = 2

    def __init__(
        self,
        rows: int = 40,
        goal_visible: bool = False,
        classes: Sequence[PointClass] = (PointClass(),),
        seed: int = 0,
        autoreset_mode: str = "DISABLED",
        end_at_goal: bool = False,
        unstable: tuple[tuple[int, int], ...] = (),
        garbage: float = 0.0,
    ):
        self.num_envs, self.goal_visible, self.end_at_goal = rows, goal_visible, end_at_goal
        self.unstable, self.garbage, self.steps = unstable, garbage, 0
        self.device = torch.device("cpu")
        self.autoreset_mode = checked_mode(autoreset_mode)
        self.metadata = {"autoreset_mode": self.autoreset_mode}
        self.num_tasks, self.num_id_columns = len(classes), 0
        self.task_names = [c.name for c in classes]
        sizes = [len(part) for part in np.array_split(np.arange(rows), len(classes))]
        ends = np.cumsum(sizes).tolist()
        self.slot_rows = [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]
        self.task_id = torch.arange(len(classes)).repeat_interleave(torch.tensor(sizes))
        self.max_episode_steps = torch.tensor([c.steps for c in classes])[self.task_id]
        self._scale = torch.tensor([c.scale for c in classes])[self.task_id]
        self._index_in_slot = torch.cat([torch.arange(size) for size in sizes])
        self.single_observation_space = Box(-5.0, 5.0, (4,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, rows)
        self.action_space = batch_space(self.single_action_space, rows)
        self.position = torch.zeros(rows, 2)
        self._ready = False
        self._seed_rows(seed)
        self.pools: list[np.ndarray] = []
        self._set_pools([circle(c.count) for c in classes])

    # Tasks.

    def set_tasks(self, pools: dict[str, np.ndarray]) -> None:
        """Replaces the goals (n, 2) of some classes; row j plays goal j mod n from the next full reset on."""
        merged = list(self.pools)
        for name, goals in pools.items():
            if name not in self.task_names:
                raise BidexError(f"Expected a slot among {', '.join(self.task_names)}, got {name!r}.")
            goals = np.asarray(goals, dtype=np.float64)
            if goals.ndim != 2 or len(goals) == 0 or goals.shape[1] != self.variation_size:
                raise BidexError(f"Expected tasks of {name} with shape (n, {self.variation_size}), got {goals.shape}.")
            merged[self.task_names.index(name)] = goals
        self._set_pools(merged)

    def _set_pools(self, pools: list[np.ndarray]) -> None:
        self.pools = pools
        self.slots = [SimpleNamespace(name=n, tasks=goals) for n, goals in zip(self.task_names, pools, strict=True)]
        self.num_slot_tasks = [len(goals) for goals in pools]
        self.task_index = self._index_in_slot % torch.tensor(self.num_slot_tasks)[self.task_id]
        chosen = zip(self.task_id.tolist(), self.task_index.tolist(), strict=True)
        self.goal = torch.from_numpy(np.stack([pools[slot][task] for slot, task in chosen])).float()
        self._ready = False

    # Episodes.

    def _seed_rows(self, seed: int) -> None:
        self.seed = seed
        pairs = zip(self.task_names, self.slot_rows, strict=True)
        self._keys = torch.cat([row_keys(seed, name, r.stop - r.start, self.device) for name, r in pairs])
        self.episodes = Episodes.fresh(self.num_envs, self.device)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        mask = reset_mask(options, self.num_envs, self.device, self._ready)
        if seed is not None:
            if not mask.all():
                raise BidexError("Expected a seed with a full reset, got it with a reset_mask.")
            self._seed_rows(seed)
        self._ready = True
        self._begin(mask)
        return self._observe(), {}

    def _begin(self, mask: Tensor) -> None:
        self.episodes.number = self.episodes.number + mask
        start = 0.2 * uniform(self._keys, self.episodes.number, 2).float() - 0.1
        self.position = torch.where(mask[:, None], start, self.position)
        self.episodes.begin(mask, torch.zeros_like(self.episodes.elapsed))

    def _observe(self) -> Tensor:
        return torch.cat([self.position, self.goal * float(self.goal_visible)], dim=1)

    def step(self, action: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        if not self._ready:
            raise BidexError("Expected reset() before step(): the rows have no episode yet.")
        action = torch.as_tensor(action, dtype=torch.float32)
        if action.shape != (self.num_envs, 2):
            raise BidexError(f"Expected actions of shape ({self.num_envs}, 2), got {tuple(action.shape)}.")
        episodes, active = self.episodes, ~self.episodes.finished
        broken = torch.zeros(self.num_envs, dtype=torch.bool)
        broken[[row for step, row in self.unstable if step == self.steps]] = True
        broken = (broken | ~action.isfinite().all(dim=1)) & active
        self.steps += 1

        moving = active & ~broken
        step = self.speed * torch.nan_to_num(action).clamp(-1.0, 1.0)
        self.position = torch.where(moving[:, None], (self.position + step).clamp(-2.0, 2.0), self.position)
        distance = (self.position - self.goal).norm(dim=1)
        success = (distance < 0.1) & ~broken
        unscaled = torch.where(moving, -distance, 0.0)
        episodes.add(active, unscaled * self._scale, unscaled, success)
        terminated = success & active & self.end_at_goal | episodes.terminated
        late = (episodes.elapsed >= self.max_episode_steps) & ~terminated
        truncated = (late | broken) & active | episodes.truncated
        ended = (terminated | truncated) & active
        final_obs = self._observe()
        info: dict[str, Any] = {
            "success": success,
            "unstable": broken,
            "reward_terms": {"distance": unscaled},
            "reward_unscaled": unscaled,
            "final_obs": final_obs,
            "_final_obs": ended,
            "episode": episodes.statistics(),
            "_episode": ended & episodes.counts,
        }
        info["final_info"] = {k: info[k] for k in ("success", "unstable", "reward_unscaled", "episode")}
        info["_final_info"] = ended
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            self._begin(ended)
        else:
            episodes.terminated, episodes.truncated = terminated.clone(), truncated.clone()
            episodes.finished = episodes.finished | ended
        reward = torch.where(broken, self.garbage, unscaled * self._scale)
        return self._observe(), reward, terminated, truncated, info

    def close(self) -> None:
        """Nothing is held."""

    def state_dict(self) -> dict[str, Any]:
        return {
            "seed": self.seed,
            "pools": [torch.from_numpy(goals.copy()) for goals in self.pools],
            "episodes": self.episodes.state_dict(),
            "position": self.position.clone(),
            "steps": self.steps,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._set_pools([goals.numpy() for goals in state["pools"]])
        self._seed_rows(int(state["seed"]))
        self.episodes.load_state_dict(state["episodes"])
        self.position, self.steps = state["position"].clone(), state["steps"]
        self._ready = True

    def best(self, obs: Tensor) -> Tensor:
        """The best action (N, 2) for observations (N, 4) that show the goal."""
        return ((obs[:, 2:] - obs[:, :2]) / self.speed).clamp(-1.0, 1.0)

"""What is played: a world with a row of each class, a policy, and the row that is looked at."""

from typing import Any

import mujoco
import numpy as np
import torch

from bidex_meta.agents import Agent
from bidex_meta.world.rendering import Ghost, ghosts, simulation


class Stage:
    """Episodes one after the other, in all rows.

    Args:
        world: A world of ours in autoreset mode DISABLED, a row of each slot.
        agent: The policy.
        row: Which row is looked at first.
        seed: Of the starts.

    Attributes:
        names: Class of each row.
        row: Which row is looked at; may be set.
    """

    def __init__(self, world: Any, agent: Agent, row: int = 0, seed: int = 0) -> None:
        self.names: list[str] = [world.task_names[int(slot)] for slot in world.task_id]
        self.row, self._world, self._agent, self._seed = row, world, agent, seed
        self._episodes, self._solved = np.zeros(len(self.names), int), np.zeros(len(self.names), int)
        self._begin()

    def _begin(self) -> None:
        self._obs, _ = self._world.reset(seed=self._seed)
        self._start(torch.ones(len(self.names), dtype=torch.bool, device=self._obs.device))

    def _start(self, mask: torch.Tensor) -> None:
        self._agent.reset(mask)
        chosen = mask.cpu().numpy()
        if not hasattr(self, "_steps"):
            size = len(self.names)
            self._steps, self._returns, self._success = np.zeros(size, int), np.zeros(size), np.zeros(size, bool)
        self._steps[chosen], self._returns[chosen], self._success[chosen] = 0, 0.0, False

    @torch.no_grad()
    def step(self) -> None:
        """One control step of all rows; those whose episodes ended begin the next."""
        self._obs, _, terminated, truncated, info = self._world.step(self._agent.eval_action(self._obs))
        self._steps += 1
        self._returns += info["reward_unscaled"].double().cpu().numpy()
        self._success |= info["success"].cpu().numpy()
        ended = terminated | truncated
        if bool(ended.any()):
            over = ended.cpu().numpy()
            self._episodes += over
            self._solved += over & self._success
            self._restart(ended)

    def restart(self) -> None:
        """The row that is looked at begins another episode; the unfinished one does not count."""
        mask = torch.zeros(len(self.names), dtype=torch.bool, device=self._obs.device)
        mask[self.row] = True
        self._restart(mask)

    def _restart(self, mask: torch.Tensor) -> None:
        self._obs, _ = self._world.reset(options={"reset_mask": mask})
        self._start(mask)

    def next_task(self) -> None:
        """Every class goes on to the next task of its pool."""
        pools = zip(self._world.task_names, self._world.pools, strict=True)
        self._world.set_tasks({name: np.roll(pool, -1, axis=0) for name, pool in pools})
        self._seed += 1
        self._begin()

    def model(self) -> mujoco.MjModel:
        """The model of the row that is looked at."""
        engine, row = simulation(self._world, self.row)
        return engine.model(row)

    def data(self) -> mujoco.MjData:
        """Its present state, forwarded, a copy."""
        engine, row = simulation(self._world, self.row)
        return engine.data(row)

    def ghosts(self) -> list[Ghost]:
        """Its goals."""
        return ghosts(self._world, self.row)

    def camera(self) -> tuple[tuple[float, float, float], float]:
        """The point that pictures of it look at, world, metres, and the camera's distance from it."""
        task = self._world.slots[int(self._world.task_id[self.row])].task_class
        return task.camera_target, task.camera_distance

    def told(self) -> dict[str, str]:
        """What to write beside it."""
        row = self.row
        most = int(self._world.max_episode_steps[row])
        return {
            "class": self.names[row],
            "step": f"{self._steps[row]} of {most}",
            "return": f"{self._returns[row]:.3g}",
            "success": "yes" if self._success[row] else "not yet",
            "episodes": f"{self._solved[row]} of {self._episodes[row]} solved",
        }

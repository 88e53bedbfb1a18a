"""The episodes that a viewer shows, and their clock."""

import time
from typing import Protocol

import mujoco
import numpy as np
import torch

from bidex_meta.agents import Agent
from bidex_meta.evaluation.play import agent_step
from bidex_meta.rules import CONTROL_RATE
from bidex_meta.world import World
from bidex_meta.world.rendering import DrawnGhost, ghosts, pose, simulation


class Stage:
    """The episodes that a viewer shows: a policy acts in all environments of a world, and one environment is shown.

    The world must be in autoreset mode DISABLED and have one environment per slot (class or listed task). ``row`` is
    the index of the shown environment; callers may change it. On a ``tour`` the next environment is shown after each
    episode.
    """

    def __init__(self, world: World, agent: Agent, row: int = 0, seed: int = 0, tour: bool = False) -> None:
        self.names: list[str] = [world.task_names[int(slot)] for slot in world.task_id]
        self.row = row
        self.tour = tour
        self._world = world
        self._agent = agent
        self._seed = seed
        size = len(self.names)
        self._episodes, self._solved, self._steps = np.zeros((3, size), int)
        self._returns = np.zeros(size)
        self._success = np.zeros(size, bool)
        self._begin()

    def _begin(self) -> None:
        self._obs, _ = self._world.reset(seed=self._seed)
        self._start(torch.ones(len(self.names), dtype=torch.bool, device=self._obs.device))

    def _start(self, mask: torch.Tensor) -> None:
        self._agent.reset(mask)
        where = mask.cpu().numpy()
        self._steps[where] = 0
        self._returns[where] = 0.0
        self._success[where] = False

    @torch.no_grad()
    def step(self) -> None:
        """Take one control step in all environments; an environment whose episode ended begins the next one."""
        running = torch.ones(len(self.names), dtype=torch.bool, device=self._obs.device)
        self._obs, _, terminated, truncated, info = agent_step(self._agent, self._world, self._obs, running)
        self._steps += 1
        self._returns += info["reward_unscaled"].double().cpu().numpy()
        self._success = info["running"]["success"].cpu().numpy().copy()
        ended = terminated | truncated
        if bool(ended.any()):
            over = ended.cpu().numpy()
            self._episodes += over
            self._solved += over & self._success
            if self.tour and over[self.row]:
                self.row = (self.row + 1) % len(self.names)
                ended[self.row] = True
            self._restart(ended)

    def restart(self) -> None:
        """Begin another episode in the shown environment; the unfinished episode does not count."""
        mask = torch.zeros(len(self.names), dtype=torch.bool, device=self._obs.device)
        mask[self.row] = True
        self._restart(mask)

    def _restart(self, mask: torch.Tensor) -> None:
        self._obs, _ = self._world.reset(options={"reset_mask": mask})
        self._start(mask)

    def next_task(self) -> None:
        """Move each class on to the next task of its pool."""
        pools = zip(self._world.task_names, self._world.pools, strict=True)
        self._world.set_tasks({name: np.roll(pool, -1, axis=0) for name, pool in pools})
        self._seed += 1
        self._begin()

    def model(self) -> mujoco.MjModel:
        """Return the model that draws the shown environment, with skins in place of the hands' collision shapes."""
        return simulation(self._world, self.row)[2].dressed

    def data(self) -> mujoco.MjData:
        """Return the shown environment's present pose, for ``model``."""
        engine, row, scene = simulation(self._world, self.row)
        data = mujoco.MjData(scene.dressed)
        pose(scene.dressed, data, engine.placement()[row])
        return data

    def ghosts(self) -> list[DrawnGhost]:
        """Return the goals of the shown environment; the list is empty in a world that hides goals."""
        return ghosts(self._world, self.row)

    def camera(self) -> tuple[tuple[float, float, float], float, tuple[float, float]]:
        """Return the camera's target (world, metres), its distance (metres), azimuth and elevation (degrees)."""
        task = self._world.slots[int(self._world.task_id[self.row])].task_class
        return task.camera_target, task.camera_distance, task.camera_angle

    def status(self) -> dict[str, str]:
        """Return labels and values to show next to the environment."""
        row = self.row
        most = int(self._world.max_episode_steps[row])
        return {
            "class": self.names[row],
            "step": f"{self._steps[row]} of {most}",
            "return": f"{self._returns[row]:.3g}",
            # If success counts at the end, the label is "yes" while the goal is held, and success may be lost again.
            "success": "yes" if self._success[row] else "not yet",
            "episodes": f"{self._solved[row]} of {self._episodes[row]} solved",
        }


_PICTURES = 30  # maximum number of pictures per second: more would only delay the browser


class Screen(Protocol):
    """A viewer; ``speed`` is 1 for real time and below 1 for slow motion."""

    paused: bool
    speed: float

    def is_open(self) -> bool:
        """Return whether the viewer is open."""
        ...

    def obey(self, stage: Stage) -> None:
        """Apply to the stage what the user has requested since the last call of this method."""

    def show(self, stage: Stage) -> None:
        """Show the stage's present state."""

    def close(self) -> None:
        """End the view."""


def play(stage: Stage, screen: Screen, seconds: float | None = None) -> None:
    """Play until the viewer is closed, or for ``seconds``.

    The viewer sets the speed. Playing is slower if the steps cannot be computed in time.
    """
    began = shown = due = time.monotonic()
    screen.show(stage)
    try:
        while screen.is_open() and (seconds is None or time.monotonic() - began < seconds):
            screen.obey(stage)
            if not screen.paused:
                stage.step()
            now = time.monotonic()
            if now - shown >= 0.9 / _PICTURES:  # a step that is slightly early is shown too
                shown = now
                screen.show(stage)
            # Delays are not caught up with, because the view would race after each pause.
            due = max(due + 1.0 / (CONTROL_RATE * screen.speed), now)
            time.sleep(due - now)
    finally:
        screen.close()

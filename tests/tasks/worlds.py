"""Small evaluation worlds for tests, and a hand on their state."""

from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from bidex_meta.engine.cpu import CpuEngine
from bidex_meta.tasks import registry
from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.scene import Scene
from bidex_meta.world import Slot, World

CASES = [(name, moving) for name in registry.names() for moving in sorted({registry.get(name).moving_base, True})]
"""Every class with each base it is used with."""
MOVING = [name for name, moving in CASES if moving]
each_case = pytest.mark.parametrize("name, moving", CASES, ids=[f"{n}-{'moving' if m else 'fixed'}" for n, m in CASES])
each_moving = pytest.mark.parametrize("name", MOVING)


def slot(task: TaskClass, tasks: int | np.ndarray = 4, reward_scale: float = 1.0) -> Slot:
    """A slot with given tasks, or with so many drawn ones."""
    pool = task.variation_space.sample(np.random.default_rng(5), tasks) if isinstance(tasks, int) else tasks
    return Slot(task.name, task, pool, reward_scale)


def world_of(
    name: str, moving: bool, num: int, tasks: int | np.ndarray = 4, reward_scale: float = 1.0, **options: Any
) -> World:
    """A world of one class; rows keep their tasks and wait for resets."""
    slots = [slot(registry.get(name, moving), tasks, reward_scale)]
    return World(slots, num, **({"autoreset_mode": "DISABLED", "threads": 1} | options))


def mixed_world(rows_a_class: int, **options: Any) -> World:
    """All classes with moving bases in one world."""
    slots = [slot(registry.get(name, True)) for name in MOVING]
    return World(slots, rows_a_class * len(slots), **({"autoreset_mode": "DISABLED", "threads": 1} | options))


def engine_of(world: World) -> CpuEngine:
    """The engine of a world of one class."""
    return world.parts[0].group.engine


def scene_of(world: World) -> Scene:
    """The scene of a world of one class."""
    return world.parts[0].group.members[0].scene


def objects_of(scene: Scene) -> list[str]:
    """Names of a scene's free objects."""
    return [name for name in scene.qpos if "/" not in name]


def observe(world: World, action: Tensor | None = None) -> np.ndarray:
    """Observations of the state that was written into the engine by hand, float64."""
    part = world.parts[0]
    part.group.engine.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
    action = torch.zeros(world.num_envs, world.action_size) if action is None else action
    return part.observe(list(part.states(world.task_index)), action).double().numpy()


class Lens:
    """MuJoCo's own view of a row: plain C kinematics of its positions."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, self.data = model, mujoco.MjData(model)

    def look(self, qpos: Tensor | np.ndarray, qvel: Tensor | np.ndarray | None = None) -> mujoco.MjData:
        """Data at given positions, with frames, contacts and, if velocities are given, these."""
        self.data.qpos[:] = np.asarray(qpos)
        self.data.qvel[:] = 0.0 if qvel is None else np.asarray(qvel)
        mujoco.mj_fwdPosition(self.model, self.data)
        mujoco.mj_fwdVelocity(self.model, self.data)
        return self.data


def depths(data: mujoco.MjData) -> np.ndarray:
    """Penetration of every contact, metres, positive inside; a zero where there is none."""
    return np.append(-data.contact.dist, 0.0)

"""Small evaluation worlds for tests, and a hand on their state."""

from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from bidex_meta.engine.cpu import CpuEngine
from bidex_meta.hands.hand import SIDES
from bidex_meta.tasks import registry
from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.scene import Scene
from bidex_meta.world import Slot, World, WorldConfig
from bidex_meta.world.part import base_rotations
from tests.tasks.oracle import Task
from tests.tasks.tables import TABLES

CASES = list(TABLES)
"""Every class with each base it is used with."""
MOVING = [name for name, moving in CASES if moving]
each_case = pytest.mark.parametrize("name, moving", CASES, ids=[f"{n}-{'moving' if m else 'fixed'}" for n, m in CASES])
V2 = [(f"{name}-v2", moving) for name, moving in CASES]
each_version = pytest.mark.parametrize("name, moving", [*CASES, *V2])
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
    return World(slots, WorldConfig(num, **({"autoreset_mode": "DISABLED", "threads": 1} | options)))


def mixed_world(rows_a_class: int, **options: Any) -> World:
    slots = [slot(registry.get(name, True)) for name in MOVING]
    return World(
        slots, WorldConfig(rows_a_class * len(slots), **({"autoreset_mode": "DISABLED", "threads": 1} | options))
    )


def engine_of(world: World) -> CpuEngine:
    return world.parts[0].group.engine


def scene_of(world: World) -> Scene:
    return world.parts[0].group.members[0].scene


def objects_of(scene: Scene) -> list[str]:
    """Names of a scene's free objects, drops of water included."""
    return [name for name, place in scene.qpos.items() if "/" not in name and place.start < scene.model.nq]


def fixtures_of(scene: Scene) -> list[str]:
    """Names of a scene's fixtures whose place differs from task to task."""
    return [name for name, place in scene.qpos.items() if place.start >= scene.model.nq]


def object_joints_of(scene: Scene) -> list[str]:
    """Full names of the joints of a scene's objects, e.g. ``bottle/slide``."""
    return [name for name in scene.qpos if "/" in name and name.partition("/")[0] not in SIDES]


def task_of(world: World, row: int) -> Task:
    """The numbers that a row's task froze, by component name; of what its episode drew the middles."""
    owner = world.slots[int(world.task_id[row])]
    drawn = owner.task_class.episode_space
    middles = {name: 0.5 * (a + b) for name, a, b in zip(drawn.names, drawn.low, drawn.high, strict=True)}
    names = owner.task_class.variation_space.names
    return middles | dict(zip(names, owner.tasks[int(world.task_index[row])].tolist(), strict=True))


def observe(world: World, action: Tensor | None = None) -> np.ndarray:
    """Observations of the state that was written into the engine by hand, float64."""
    part = world.parts[0]
    part.group.engine.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
    action = torch.zeros(world.num_envs, world.action_size) if action is None else action
    return part.observe(list(part.states(world.task_index)), action, *base_rotations([part])).double().numpy()


def set_pose(world: World, row: int, part: str, values: np.ndarray) -> None:
    """Writes positions of a free object or an object's joint into a row and takes its velocity away."""
    engine, scene = engine_of(world), scene_of(world)
    engine.qpos[row, scene.qpos[part]] = torch.from_numpy(np.asarray(values, dtype=np.float64))
    first, size = dofs_of(scene, part)
    engine.qvel[row, first : first + size] = 0.0


def dofs_of(scene: Scene, part: str) -> tuple[int, int]:
    """First degree of freedom of a free object or an object's joint, and how many it has."""
    free = "/" not in part
    return int(scene.model.joint(f"{part}/free" if free else part).dofadr[0]), 6 if free else 1


def send_hands_away(scene: Scene, start: Tensor) -> None:
    """Moves the bases in starts (n, nq + 7 nmocap) far from the objects, the floor and each other."""
    for i, side in enumerate(SIDES):
        first = scene.qpos[f"{side}/base"].start
        start[:, first] += 5.0 * i
        start[:, first + 2] += 5.0


def restart(world: World, start: Tensor) -> None:
    """Starts all rows of a world of one class anew at given positions, shape (n, nq + 7 nmocap)."""
    engine_of(world).reset(torch.ones(world.num_envs, dtype=torch.bool), start)


class Lens:
    """MuJoCo's own view of a row: plain C kinematics of its positions."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, self.data = model, mujoco.MjData(model)

    def look(self, place: Tensor | np.ndarray, qvel: Tensor | np.ndarray | None = None) -> mujoco.MjData:
        """Data with frames and contacts at given positions: ``qpos``, then the poses of fixtures if they are given."""
        place, nq = np.asarray(place), self.model.nq
        self.data.qpos[:] = place[:nq]
        self.data.qvel[:] = 0.0 if qvel is None else np.asarray(qvel)
        if len(place) > nq:
            fixtures = place[nq:].reshape(-1, 7)
            self.data.mocap_pos[:], self.data.mocap_quat[:] = fixtures[:, :3], fixtures[:, 3:]
        mujoco.mj_fwdPosition(self.model, self.data)
        mujoco.mj_fwdVelocity(self.model, self.data)
        return self.data


def depths(data: mujoco.MjData) -> np.ndarray:
    """Penetration of every contact, metres, positive inside; a zero where there is none."""
    return np.append(-data.contact.dist, 0.0)

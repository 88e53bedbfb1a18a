"""Goals in pictures: none where a suite hides them, and in version 2 one for all that a task hides, in its place."""

import contextlib
from itertools import product

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.play import ZeroAgent
from bidex_meta.tasks import registry
from bidex_meta.utils import gl_backend
from bidex_meta.viewer.playback import Stage
from bidex_meta.world import World
from bidex_meta.world.rendering import DrawnGhost, ghosts
from tests.tasks import wide
from tests.tasks.worlds import MOVING, engine_of, restart, scene_of, set_pose, task_of, world_of
from tools.gallery import masked

EGGS = ("HandOver", "CatchUnderarm", "CatchOver2Underarm", "CatchAbreast")
PLACES = {
    **{name: ["object/object"] for name in (*EGGS, "LiftUnderarm")},
    "TwoCatchUnderarm": ["object1/object", "object2/object"],
    **{name: ["object/right_handle", "object/left_handle"] for name in MOVING if name.startswith("Door")},
    "BottleCap": ["bottle/cap"],
    "PushBlock": ["block1/object", "block2/object"],
    "SwingCup": ["cup/object"],
    "OpenScissors": ["scissors/right_handle"],
    "ReOrientation": ["object1/object"] * 3 + ["object2/object"] * 3,
    "OpenPenCap": ["pen/cap"],
    "Switch": ["switch1/button", "switch2/button"],
    "StackBlock": ["block1/object", "block2/object"],
    "PourWater": ["bucket/object"],
    "GraspAndPlace": ["bucket/object"],
}
"""Bodies' origins and sites that lie in the ghosts of a solved state."""


def other_ends(name: str, columns: list[int]) -> np.ndarray:
    """Two tasks that differ in some columns alone: a quarter and three quarters of their ranges."""
    space = registry.get(name, True).variation_space
    low, high = np.array(space.low), np.array(space.high)
    tasks = np.stack([0.75 * low + 0.25 * high] * 2)
    tasks[1, columns] = (0.25 * low + 0.75 * high)[columns]
    return tasks


def in_equal_states(name: str, columns: list[int], rule: str) -> World:
    """A world of two environments in one state whose tasks differ in some columns alone."""
    world = world_of(name, True, 2, tasks=other_ends(name, columns), observation=rule)
    world.reset(seed=0)
    restart(world, engine_of(world).placement()[:1].repeat(2, 1))
    return world


def drawn(goals: list[DrawnGhost]) -> np.ndarray:
    """What is seen of goals, in no order: where they are, how they extend along the world's axes, and their colour."""
    rows = []
    for ghost in goals:
        turn = Rotation.from_quat(ghost.quaternion, scalar_first=True).as_matrix()
        extent = turn @ np.diag(ghost.size**2) @ turn.T
        rows.append((*ghost.position, *(10.0 * extent.ravel()), *ghost.colour))
    return np.array(sorted(rows))


@pytest.mark.parametrize("name", [f"{name}{version}" for name, version in product(MOVING, ("", "-v2"))])
def test_pictures_do_not_tell_what_a_suite_hides(name: str) -> None:
    task, names = registry.get(name, True), registry.get(name, True).variation_space.names
    reward, success = masked(task)
    columns = sorted({*task.hidden_columns(), *(names.index(component) for component in reward + success)})
    world = in_equal_states(name, columns, "masked")
    assert ghosts(world, 0) == ghosts(world, 1) == []
    with contextlib.suppress(BidexError):  # a machine that cannot draw
        gl_backend.prepare()
        first, second = world._painter.pictures(world, 32)
        assert torch.equal(first, second) and first.float().std() > 5.0
    assert Stage(world, ZeroAgent(world.action_space)).ghosts() == []
    world.close()


@pytest.mark.parametrize("name", MOVING)
def test_version_2_draws_all_that_a_task_hides(name: str) -> None:
    for column in registry.get(f"{name}-v2", True).hidden_columns():
        world = in_equal_states(f"{name}-v2", [column], "plain")
        first, second = drawn(ghosts(world, 0)), drawn(ghosts(world, 1))
        assert len(first) > 0 and np.abs(first - second).max() > 1e-3, column


class Centre:
    """Random numbers that are the middle of their range."""

    def uniform(self, low: float, high: float, size: int | None = None) -> float | np.ndarray:
        return np.full(size, 0.5 * (low + high)) if size is not None else 0.5 * (low + high)

    def normal(self, size: int) -> np.ndarray:
        return np.zeros(size)

    def random(self) -> float:
        return 0.5

    def integers(self, low: int, high: int | None = None) -> int:
        return (low if high is None else high) - 1

    def choice(self, values: tuple[float, ...]) -> float:
        return values[0]


LIFTED = {"StackBlock": 0.013, "PushBlock": 0.006, "ReOrientation": 0.09}
"""How far the states of ``wide.near`` lie above the goals, metres; elsewhere hardly."""


@pytest.mark.parametrize("name", MOVING)
def test_ghosts_stand_where_a_state_is_solved(name: str) -> None:
    """After steps too, by which objects have moved from where the task put them."""
    world = world_of(f"{name}-v2", True, 3, tasks=3)
    world.reset(seed=1)
    for _ in range(5):
        world.step(torch.ones(3, world.action_size))
    engine, scene = engine_of(world), scene_of(world)
    for row in range(3):
        for part, values in wide.near(name, engine.data(row), task_of(world, row), Centre()).items():  # type: ignore[arg-type]
            set_pose(world, row, part, values)
    engine.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
    ((_, _, state),) = world.parts[0].states(world.task_index)
    assert scene.task.success(state).all()
    for row in range(3):
        data, found = engine.data(row), ghosts(world, row)
        assert len(found) == len(PLACES[name])
        for i, (ghost, place) in enumerate(zip(found, PLACES[name], strict=True)):
            body = place.endswith("/object")
            wanted = (data.body(place).xpos if body else data.site(place).xpos).copy()
            if name == "ReOrientation":
                wanted += 0.05 * data.body(place).xmat.reshape(3, 3)[:, i % 3]
            off = np.abs(ghost.position - wanted)
            assert off[:2].max() < 1e-5 and off[2] < LIFTED.get(name, 1e-5), place
            if name in ("SwingCup", "ReOrientation"):
                turned = Rotation.from_quat(ghost.quaternion, scalar_first=True)
                is_turned = Rotation.from_quat(data.body(place).xquat, scalar_first=True)
                assert (turned * is_turned.inv()).magnitude() < 1e-5

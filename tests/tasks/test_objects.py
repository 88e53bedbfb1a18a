"""What stands on tables or hangs in hinges: rest, joints that stay where they are left, switches, kettle, bucket."""

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bidex_meta.tasks import registry
from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.bucket import PourWater
from bidex_meta.tasks.scene import Scene
from bidex_meta.world import World, WorldConfig
from tests.hands import figures
from tests.tasks import worlds
from tests.tasks.formulas import FORMULAS
from tests.tasks.oracle import frame, pose, shifted
from tests.tasks.tables import PLACES

SECOND = 60
THROWN = ("HandOver", "CatchUnderarm", "CatchOver2Underarm", "TwoCatchUnderarm", "CatchAbreast", "ReOrientation")
STANDING = [name for name in PLACES if name not in THROWN and name != "BottleCap"]


def alone(task: TaskClass, rows: int) -> World:
    """A world at the starts of its first episodes, the hands far away."""
    world = World([worlds.slot(task, rows)], WorldConfig(rows, autoreset_mode="DISABLED", threads=1))
    world.reset(seed=0)
    start = worlds.engine_of(world).placement()
    worlds.send_hands_away(worlds.scene_of(world), start)
    worlds.restart(world, start)
    return world


@worlds.each_moving
def test_contacts_and_limits_are_as_stiff_as_the_time_step_allows(name: str) -> None:
    model = worlds.scene_of(worlds.world_of(name, True, 1)).model
    meets = (model.geom_contype | model.geom_conaffinity) > 0
    limited = (model.jnt_limited > 0) & (model.jnt_type != mujoco.mjtJoint.mjJNT_FREE)
    for constants in (model.geom_solref[meets, 0], model.jnt_solref[limited, 0], model.tendon_solref_lim[:, 0]):
        assert len(constants) and (constants >= 2.0 * model.opt.timestep).all()
        assert (constants <= 2.02 * model.opt.timestep).all(), name


def wait(world: World, steps: int) -> None:
    for _ in range(steps):
        world.parts[0].step(torch.zeros(world.num_envs, world.action_size).double(), None)
    assert not worlds.engine_of(world).unstable().any()


def joints_of(scene: Scene) -> list[str]:
    return [joint for joint in worlds.object_joints_of(scene) if not joint.startswith("water")]


@pytest.mark.parametrize("name", [*STANDING, *(f"{name}-v2" for name in STANDING)])
def test_objects_rest_where_they_start(name: str) -> None:
    """No jump, no drift, no falling over; caps and lids stay on, leaves and rockers where they are."""
    world = alone(registry.get(name, True), 3)
    engine, scene = worlds.engine_of(world), worlds.scene_of(world)
    before = engine.qpos.numpy().copy()
    for _ in range(4):
        wait(world, SECOND // 4)
        for body in worlds.objects_of(scene):
            shift = engine.qpos[:, scene.qpos[body]].numpy()[:, :3] - before[:, scene.qpos[body]][:, :3]
            assert np.abs(shift).max() < 0.005, (body, shift)
    for body in worlds.objects_of(scene):
        first, _ = worlds.dofs_of(scene, body)
        assert np.abs(engine.qvel[:, first : first + 3].numpy()).max() < 0.05, body
        for old, new in zip(before[:, scene.qpos[body]], engine.qpos[:, scene.qpos[body]].numpy(), strict=True):
            turned = figures.rotation(new[3:]) * figures.rotation(old[3:]).inv()
            assert turned.magnitude() < 0.03, body
    for joint in joints_of(scene):
        moved = engine.qpos[:, scene.qpos[joint]].numpy() - before[:, scene.qpos[joint]]
        assert np.abs(moved).max() < 0.003, joint


@pytest.mark.parametrize("name, angle", [("DoorOpenOutward", 0.7), ("Switch", 0.4), ("OpenScissors", 0.1)])
def test_hinges_stay_where_they_are_left(name: str, angle: float) -> None:
    world = alone(registry.get(name, True), 2)
    engine, scene = worlds.engine_of(world), worlds.scene_of(world)
    for joint in joints_of(scene):
        engine.qpos[:, scene.qpos[joint]] = angle
    wait(world, SECOND // 2)
    for joint in joints_of(scene):
        np.testing.assert_allclose(engine.qpos[:, scene.qpos[joint]].numpy(), angle, atol=0.01, err_msg=joint)


@pytest.mark.parametrize("count", [8, 30])
def test_water_stays_in_the_kettle_until_it_is_tilted(count: int) -> None:
    """None leaves the upright kettle in half a second; a tilt of 40 degrees empties it by more than a third."""
    world = alone(PourWater(True, count), 1)
    scene, model = worlds.scene_of(world), worlds.scene_of(world).model
    assert worlds.depths(worlds.Lens(model).look(worlds.engine_of(world).placement()[0])).max() < 0.005
    assert len(FORMULAS["PourWater"].water(worlds.Lens(model).data)) == count
    wait(world, SECOND // 2)
    data = worlds.Lens(model).look(worlds.engine_of(world).placement()[0])
    assert left(data, count) == 0
    base, turn = frame(data, "kettle/object")
    tilted = turn * Rotation.from_rotvec([0, -np.deg2rad(40), 0])
    place = pose(shifted(base, 0, 0, 1.0), tilted)
    inside = [turn.inv().apply(data.body(f"water{i}/object").xpos - base) for i in range(count)]
    for i in range(count):
        for axis, value in zip("xyz", place[:3] + tilted.apply(inside[i]), strict=True):
            data.qpos[scene.qpos[f"water{i}/{axis}"]] = value
    first, size = worlds.dofs_of(scene, "kettle")
    data.qvel[:] = 0.0
    for _ in range(2 * 240):
        data.qpos[scene.qpos["kettle"]], data.qvel[first : first + size] = place, 0.0
        mujoco.mj_step(model, data)
    assert 3 * left(data, count) > count, f"{left(data, count)} of {count} drops have left"


def left(data: mujoco.MjData, count: int) -> int:
    """Drops below the kettle's spout by more than its height or beyond it: out of the kettle."""
    base, turn = frame(data, "kettle/object")
    drops = [turn.inv().apply(data.body(f"water{i}/object").xpos - base) for i in range(count)]
    return sum(float(np.hypot(x, y)) > 0.205 or z < -0.08 for x, y, z in drops)

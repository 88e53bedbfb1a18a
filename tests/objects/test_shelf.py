"""Every thing of the shelf: published size and mass, starts, stability, and that a hand holds it."""

import json

import mujoco
import numpy as np
import pytest
import torch

from bidex_meta.cli import main
from bidex_meta.tasks import registry
from bidex_meta.tasks.objects.held import held_object, shelf
from bidex_meta.tasks.scene import compile_scene
from bidex_meta.world import World, WorldConfig
from tests.tasks.worlds import Lens, depths, engine_of, scene_of, slot

ROWS = 48
each_thing = pytest.mark.parametrize("thing", shelf())
PUBLISHED = {
    # mm in ascending order and g: Calli et al. 2015, the table of the YCB set; what is round has its diameter twice.
    "sugar_box": ((38, 89, 175), 514), "soup_can": ((66, 66, 101), 349), "mustard_bottle": ((58, 95, 190), 603),
    "tuna_can": ((33, 85, 85), 171), "pudding_box": ((35, 89, 110), 187), "gelatin_box": ((28, 73, 85), 97),
    "meat_can": ((50, 82, 97), 370), "apple": ((75, 75, 75), 68), "pear": ((66.2, 66.2, 100), 49),
    "hammer": ((24, 32, 135), 665), "tennis_ball": ((64.7, 64.7, 64.7), 58), "rubiks_cube": ((57, 57, 57), 94),
}  # fmt: skip
LONG = {"banana": (190, 66), "mug": (None, 118), "pen": (216, 42.36), "block": (50, 70.9)}
"""Others: longest side (mm) and mass (g)."""


def world_with(name: str, thing: str, rows: int, moving: bool | None = True) -> World:
    """Environments of a class with an object, each with a task of its own; they wait for resets."""
    slots = [slot(registry.get(name, moving, object=thing), min(rows, 16))]
    return World(slots, WorldConfig(rows, autoreset_mode="DISABLED", threads=1))


def test_the_command_lists_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "objects", "--json"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    assert set(rows) == {"egg", *shelf()}
    assert rows["tuna_can"] == {"name": "tuna_can", "mass_g": 171.0, "box_mm": "85 x 85 x 33", "geoms": 1}


@pytest.mark.parametrize("thing", PUBLISHED)
def test_sizes_and_masses_are_the_published_ones(thing: str) -> None:
    """By MuJoCo's own boxes around each geom, which no code of ours computes."""
    size, mass = PUBLISHED[thing]
    model = compile_scene(registry.get("HandOver", object=thing)).model
    data, body = mujoco.MjData(model), model.body("object/object").id
    mujoco.mj_kinematics(model, data)
    corners = []
    for geom in np.flatnonzero(model.geom_bodyid == body):
        centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        turn, place = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom] - data.xpos[body]
        signs = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
        corners.append((centre + signs * half) @ turn.T + place)
    corners = np.concatenate(corners)
    np.testing.assert_allclose(np.sort(np.ptp(corners, axis=0)) * 1000, sorted(size), atol=0.2)
    assert model.body_mass[body] * 1000 == pytest.approx(mass, abs=0.5)


@pytest.mark.parametrize("thing", LONG)
def test_the_others(thing: str) -> None:
    longest, mass = LONG[thing]
    found = held_object(thing)
    assert found is not None and found.mass * 1000 == pytest.approx(mass, abs=0.5)
    sides = np.subtract(found.high, found.low) * 1000
    assert longest is None or sides.max() == pytest.approx(longest, abs=0.5)
    if thing == "mug":  # 80 mm wide without its handle, 82 high
        assert found.high[2] - found.low[2] == pytest.approx(0.082) and -found.low[0] == pytest.approx(0.037, abs=0.004)


@each_thing
def test_outlines_hold_all_of_it(thing: str) -> None:
    """Against MuJoCo's own collision function: no ray from outside meets it beyond its support."""
    found, model = held_object(thing), compile_scene(registry.get("HandOver", object=thing)).model
    assert found is not None
    data, body = mujoco.MjData(model), model.body("object/object").id
    mujoco.mj_kinematics(model, data)
    rng, hit = np.random.default_rng(0), np.zeros(1, dtype=np.int32)
    group = np.ones(6, dtype=np.uint8)
    for _ in range(200):
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        start = data.xpos[body] + 0.3 * direction + 0.05 * rng.normal(size=3)
        distance = mujoco.mj_ray(model, data, start, -direction, group, 1, -1, hit)
        if distance < 0 or model.geom_bodyid[hit[0]] != body:
            continue
        met = data.xmat[body].reshape(3, 3).T @ (start - distance * direction - data.xpos[body])
        for axis in rng.normal(size=(8, 3)):
            axis /= np.linalg.norm(axis)
            assert met @ axis <= (found.centres @ axis + found.radii).max() + 1.5e-3


@each_thing
def test_starts_are_clear_differ_and_follow_the_seed(thing: str) -> None:
    world = world_with("CatchUnderarm", thing, ROWS)
    world.reset(seed=0)
    first, lens = engine_of(world).placement().numpy().copy(), Lens(scene_of(world).model)
    assert max(float(depths(lens.look(row)).max()) for row in first) < 0.005
    ((_, _, state),) = world.parts[0].states(world.task_index)
    assert not world.slots[0].task_class.success(state).any()
    assert len(np.unique(first, axis=0)) == ROWS
    world.reset(seed=1)
    assert (engine_of(world).placement().numpy() != first).any(axis=1).all()
    world.reset(seed=0)
    np.testing.assert_array_equal(engine_of(world).placement().numpy(), first)


@each_thing
def test_nothing_blows_up_in_an_episode_of_random_actions(thing: str) -> None:
    """75 steps from one start to the time limit; half of the rows do nothing."""
    world, rng = world_with("CatchUnderarm", thing, 16), torch.Generator().manual_seed(0)
    world.reset(seed=0)
    broken = torch.zeros(16, dtype=torch.bool)
    columns, model = scene_of(world).qpos["object"], scene_of(world).model
    first = int(model.joint("object/free").dofadr[0])
    running = torch.ones(16, dtype=torch.bool)
    for _ in range(75):
        action = 2 * torch.rand(16, 52, generator=rng) - 1
        action[::2] = 0.0
        obs, _, terminated, truncated, info = world.step(action)
        assert obs.isfinite().all()
        broken |= info["unstable"]
        speed = engine_of(world).qvel[running, first : first + 3].norm(dim=1)
        assert not len(speed) or speed.max() < 15.0  # a hand throws; a contact that breaks kicks far harder
        running &= ~(terminated | truncated)
        if not running.any():
            break
    assert not broken.any() and engine_of(world).qpos[:, columns].isfinite().all()


@each_thing
@pytest.mark.parametrize("dropped", [False, True], ids=["held", "caught"])
def test_a_level_hand_holds_it_and_catches_it_out_of_the_air(thing: str, dropped: bool) -> None:
    """On a fixed palm without noise, along the fingers, which bend around it; or dropped by 5 cm meanwhile."""
    world = world_with("HandOver", thing, 1, moving=False)
    world.reset(seed=0)
    scene, engine = scene_of(world), engine_of(world)
    task, start = scene.task, torch.from_numpy(scene.start_qpos)[None].clone()
    views = {name: start[:, columns] for name, columns in scene.qpos.items()}
    task.start(torch.zeros(1, task.start_draws, dtype=start.dtype), {}, views)
    place = views["object"][0, :3]
    if dropped:
        place[1:] += torch.tensor((0.02, 0.05), dtype=start.dtype)  # towards the palm, and up
    engine.reset(torch.ones(1, dtype=torch.bool), start)
    for _ in range(74 if dropped else 60):
        _, _, terminated, _, info = world.step(torch.zeros(1, 40))
        assert dropped or not (terminated.any() or info["unstable"].any())
    after = engine.qpos[0, scene.qpos["object"]][:3]
    assert after[2] > 0.5 and (dropped or (after - place).abs().max() < 0.06)

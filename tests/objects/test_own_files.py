"""The user's own MJCF files: what of them counts, meshes, and pots, bottles and cups that name their points."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from bidex_meta import BidexError, make_task_world
from bidex_meta.tasks import registry
from bidex_meta.tasks.scene import compile_scene
from bidex_meta.utils import paths
from tests.tasks.worlds import Lens, depths, engine_of, scene_of

OBJ = "\n".join(f"v {x} {y} {z}" for x in (-0.02, 0.02) for y in (-0.03, 0.03) for z in (-0.04, 0.04)) + (
    "\nf 1 2 4\nf 1 4 3\nf 5 8 6\nf 5 7 8\nf 1 5 6\nf 1 6 2\nf 3 4 8\nf 3 8 7\nf 1 3 7\nf 1 7 5\nf 2 6 8\nf 2 8 4\n"
)
MESH = """<mujoco><compiler meshdir="parts"/><asset><mesh name="brick" file="brick.obj"/></asset><worldbody>
<body name="brick"><freejoint/><inertial pos="0 0 0.001" mass="0.2" diaginertia="1e-4 2e-4 2.5e-4"/>
<geom type="mesh" mesh="brick" friction="0.4 0.005 0.001"/>
<geom type="sphere" size="0.2" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""


@pytest.fixture
def brick(tmp_path: Path) -> str:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "brick.obj").write_text(OBJ)
    (tmp_path / "brick.xml").write_text(MESH)
    return str(tmp_path / "brick.xml")


def test_mass_inertia_friction_and_mesh_are_the_files_and_contacts_ours(brick: str) -> None:
    task = registry.get("TwoCatchUnderarm", object=brick)
    model = compile_scene(task).model
    cube = compile_scene(registry.get("TwoCatchUnderarm", object="block")).model
    for name in ("object1", "object2"):
        body = model.body(f"{name}/object")
        assert body.mass[0] == 0.2 and sorted(body.inertia) == pytest.approx([1e-4, 2e-4, 2.5e-4])
        shown, seen = (int(body.geomadr[0]) + i for i in (0, 1))
        assert model.geom_friction[shown, 0] == 0.4 and model.geom_contype[seen] == 0
        like = int(cube.body(f"{name}/object").geomadr[0])
        for numbers in ("geom_solref", "geom_solimp", "geom_margin", "geom_condim", "geom_contype", "geom_conaffinity"):
            np.testing.assert_array_equal(getattr(model, numbers)[shown], getattr(cube, numbers)[like], numbers)
    assert task.held.half_extents == pytest.approx((0.02, 0.03, 0.04), abs=1e-6)  # type: ignore[attr-defined]
    world = make_task_world("TwoCatchUnderarm", 4, "cpu", threads=1, object=brick)
    world.reset(seed=0)
    assert torch.isfinite(world.step(torch.zeros(4, 52))[0]).all()


def test_an_object_starts_on_a_broad_side(brick: str) -> None:
    """Its shortest side (x) along the palm's normal, whatever the draws; either side below."""
    world = make_task_world("CatchUnderarm", 64, "cpu", threads=1, object=brick)
    world.reset(seed=0)
    scene = world.parts[0].group.members[0].scene
    poses = world.parts[0].group.engine.qpos[:, scene.qpos["object"]].numpy()
    turn, up = np.zeros(9), []
    for pose in poses:
        mujoco.mju_quat2Mat(turn, pose[3:])
        up.append(turn.reshape(3, 3)[2, 0])
    assert np.abs(up) == pytest.approx(1.0, abs=1e-5)
    assert 16 < (np.array(up) > 0).sum() < 48


EXAMPLES = {"LiftUnderarm": "roasting_tin", "BottleCap": "flask", "SwingCup": "tankard"}
_MOVED = {"LiftUnderarm": 0.01, "BottleCap": 0.1, "SwingCup": 0.01}
"""Metres in a second of doing nothing: two stand on a table, a bottle sinks with the hand that yields under it."""


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_examples_start_clear_stay_and_do_not_blow_up(name: str) -> None:
    file = paths.assets_dir().parent / "examples" / "objects" / f"{EXAMPLES[name]}.xml"
    world = make_task_world(name, 8, "cpu", threads=1, object=str(file), autoreset_mode="DISABLED", stagger=False)
    world.reset(seed=0)
    scene, engine = scene_of(world), engine_of(world)
    lens = Lens(scene.model)
    assert max(float(depths(lens.look(row)).max()) for row in engine.placement().numpy()) < 0.005
    columns, rng = scene.qpos[scene.task.own.name], torch.Generator().manual_seed(0)  # type: ignore[attr-defined]
    before = engine.qpos[:, columns].clone()
    for _ in range(60):
        assert not world.step(torch.zeros(8, 52))[-1]["unstable"].any()
    assert (engine.qpos[:, columns] - before)[:, :3].norm(dim=1).max() < _MOVED[name]
    world.reset(seed=1)
    for _ in range(75):
        obs, _, _, _, info = world.step(2 * torch.rand(8, 52, generator=rng) - 1)
        assert obs.isfinite().all() and not info["unstable"].any()


def test_a_bottle_that_starts_in_the_palm_is_one_line_and_a_changed_file_another_object(tmp_path: Path) -> None:
    text = (paths.assets_dir().parent / "examples" / "objects" / "flask.xml").read_text()
    file = tmp_path / "flask.xml"
    file.write_text(text)
    first = registry.get("BottleCap", True, object=str(file))
    file.write_text(text.replace('mass="0.38"', 'mass="0.3"'))
    second = registry.get("BottleCap", True, object=str(file))
    assert first.scene_key != second.scene_key
    file.write_text(text.replace('size="0.03"', 'size="0.06"'))
    with pytest.raises(BidexError, match=r"starts clear of hands and table, got one \d+ mm deep in right/\w+\. Make"):
        registry.get("BottleCap", True, object=str(file))


def test_more_geoms_get_more_room(tmp_path: Path) -> None:
    text = (paths.assets_dir().parent / "examples" / "objects" / "tankard.xml").read_text()
    rivets = "".join(f'<geom size="0.002" pos="0 0 {0.002 * i}" mass="0.001"/>' for i in range(20))
    (tmp_path / "riveted.xml").write_text(
        text.replace('<site name="right_handle"', f'{rivets}<site name="right_handle"')
    )
    usual, own = (registry.get("SwingCup", True, **more) for more in ({}, {"object": str(tmp_path / "riveted.xml")}))
    assert own.scene_key != usual.scene_key and own.layout == usual.layout
    assert own.needs.contacts > usual.needs.contacts and own.needs.rows > usual.needs.rows


@pytest.mark.parametrize(
    "old, new, told",
    [
        ('<site name="right_handle"', '<site name="ear"', "right_handle"),
        ('name="right_handle_position"', 'name="ear_position"', "the sensors of assets/objects/pot.xml"),
        ('<joint name="slide"', '<joint name="lift"', "the joints of assets/objects/pot.xml"),
        ('<body name="object">', '<body name="pan">', 'a body called "object"'),
        ('mass="0.8" friction', 'mass="80" friction', "at most 10 kg"),
        ('0.116 0.002" pos="0 0 -0.0545" mass="0" contype="0"', '0.116 0.04" pos="0 0 -0.0545" mass="0"', "stands"),
        ('<body name="object">', '<body name="object" euler="0 0 30">', "a <body> without pos and orientation"),
        ('<body name="lid">', '<body name="lid"><inertial pos="0 0 1" mass="1" diaginertia="1 1 1"/>', "mass inside"),
        ('mass="0.8" friction="', 'mass="0.8" friction="-', "friction of 0 to 5, got -"),
        ("</mujoco>", '<actuator><motor joint="slide"/></actuator></mujoco>', "<actuator>"),
    ],
)
def test_a_pot_without_what_the_class_reads_is_one_line(old: str, new: str, told: str, tmp_path: Path) -> None:
    text = (paths.assets_dir() / "objects" / "pot.xml").read_text()
    assert old in text
    (tmp_path / "pot.xml").write_text(text.replace(old, new))
    with pytest.raises(BidexError) as raised:
        registry.get("LiftUnderarm", True, object=str(tmp_path / "pot.xml"))
    assert told in str(raised.value) and "\n" not in str(raised.value)
    with pytest.raises(BidexError, match="takes the place of the pot"):
        registry.get("LiftUnderarm", True, object="mug")

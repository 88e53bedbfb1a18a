"""The hand against the original's figures (docs/figures.md)."""

from collections import Counter

import mujoco
import numpy as np
import pytest

from bidex_meta.hands import looks
from bidex_meta.hands.hand import INNER, SIDES, add_hands, hand, hand_spec
from bidex_meta.hands.poses import HandPose
from bidex_meta.tasks import registry
from bidex_meta.tasks.scene import compile_scene
from tests.hands import figures


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return hand_spec().compile()


@pytest.mark.parametrize("name", ["CatchUnderarm", "SwingCup", "PourWater"])
def test_the_hands_float_and_all_else_falls(name: str) -> None:
    """Gravity as it acts on every degree of freedom at rest: nothing on the hands, m g on whatever is free."""
    model = compile_scene(registry.get(name)).model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    pull = data.qfrc_passive - data.qfrc_bias  # at rest: gravity compensation and gravity
    of_hand = np.array([model.joint(j).name.startswith(("right/", "left/")) for j in model.dof_jntid])
    np.testing.assert_allclose(pull[of_hand], 0.0, atol=1e-3)
    free = [j for j in range(model.njnt) if model.joint(j).name.endswith("/free") and not of_hand[model.jnt_dofadr[j]]]
    for joint in free:
        mass = model.body_subtreemass[model.jnt_bodyid[joint]]
        np.testing.assert_allclose(pull[model.jnt_dofadr[joint] :][:3], (0.0, 0.0, -9.81 * mass), rtol=1e-6, atol=1e-9)
    assert free


def test_joint_tables(model: mujoco.MjModel) -> None:
    known = hand()
    assert list(known.joints) == figures.NAMES
    np.testing.assert_array_equal(known.low, figures.LOW)
    np.testing.assert_array_equal(known.high, figures.HIGH)
    assert known.actuated.tolist() == figures.ACTUATED
    np.testing.assert_array_equal(known.control_low, figures.LOW[figures.ACTUATED])
    np.testing.assert_array_equal(known.control_high, figures.HIGH[figures.ACTUATED])
    assert known.index("WRJ1", "FFJ0", "THJ0") == [0, 5, 23]
    for i, (name, low, high, damping, armature, *_) in enumerate(figures.JOINTS):
        joint = model.joint(name)
        assert (joint.id, joint.range.tolist(), joint.limited[0]) == (i, [low, high], 1), name
        assert (joint.damping[0], joint.armature[0]) == (damping, armature), name


def test_actuators(model: mujoco.MjModel) -> None:
    rows = [joint for joint in figures.JOINTS if joint[5]]
    assert [figures.NAMES.index(joint[0]) for joint in rows] == figures.ACTUATED
    for i, (name, low, high, *_, kp, effort) in enumerate(rows):
        actuator = model.actuator(i)
        assert model.joint(actuator.trnid[0]).name == name
        assert actuator.ctrlrange.tolist() == [low, high], name
        assert (actuator.gainprm[0], actuator.biasprm[1]) == (kp, -kp), name
        assert actuator.forcerange.tolist() == [-effort, effort], name


def test_self_collision_pairs(model: mujoco.MjModel) -> None:
    named = [
        frozenset(model.geom(g).name.removeprefix("C_") for g in pair)
        for pair in zip(model.pair_geom1, model.pair_geom2, strict=True)
    ]
    assert len(named) == 18 and set(named) == figures.PAIRS
    assert set(model.pair_dim) == {1}


def test_collision_geoms(model: mujoco.MjModel) -> None:
    solid = {model.geom(i).name: model.geom(i) for i in range(model.ngeom) if model.geom_contype[i]}
    assert set(solid) == {f"C_{name}" for name in [*figures.GEOMS, "forearm"]}
    for name, (position, size, condim) in figures.GEOMS.items():
        geom = solid[f"C_{name}"]
        np.testing.assert_allclose(geom.pos, position, atol=1e-9, err_msg=name)
        np.testing.assert_allclose(geom.size[: len(size)], size, err_msg=name)
        assert geom.type[0] == (mujoco.mjtGeom.mjGEOM_CAPSULE if len(size) == 2 else mujoco.mjtGeom.mjGEOM_BOX), name
        assert geom.condim[0] == condim, name
        assert model.body(geom.bodyid[0]).name == name.rstrip("01"), name
    assert all(geom.friction.tolist() == [1.0, 0.005, 0.001] for geom in solid.values())


@pytest.mark.parametrize("moving", [False, True])
def test_zero_pose_kinematics(moving: bool) -> None:
    scene = mujoco.MjSpec()
    add_hands(scene, HandPose((0, 0, 0), (0, 0, 0)), HandPose((5, 0, 0), (0, 0, 0)), moving)
    model = scene.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for name, expected in figures.ZERO_POSE.items():
        if name == "hand_point":
            found = data.site("right/hand_point").xpos
        else:
            body = data.body(f"right/{name}")
            found = body.xpos + (0.02 * body.xmat.reshape(3, 3)[:, 2] if name in figures.TIPS else 0.0)
        np.testing.assert_allclose(found, expected, atol=6e-4, err_msg=name)
    palm = data.body("right/palm").xmat.reshape(3, 3)
    np.testing.assert_allclose(palm, np.array([[-1, 0, 0], [0, 0, -1], [0, -1, 0]]), atol=1e-9)


@pytest.mark.parametrize("name", registry.names())
@pytest.mark.parametrize("moving", [False, True])
def test_mounts_of_the_classes(name: str, moving: bool) -> None:
    model = compile_scene(registry.get(name, moving)).model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for side, (position, quaternion) in zip(SIDES, figures.CLASS_MOUNTS[name], strict=True):
        mount = data.body(f"{side}/mount")
        np.testing.assert_allclose(mount.xpos, position, atol=1e-9, err_msg=side)
        assert figures.same_orientation(mount.xquat, quaternion, 2e-3), (side, mount.xquat)


def kind(geom: str) -> str:
    return geom.split("/")[0]


@pytest.mark.parametrize("name", registry.names())
def test_contact_bits(name: str) -> None:
    """Hand and hand, hand and object, all and floor may meet; a hand with itself only in its listed pairs.

    Geoms inside an object's outline need not meet what stands.
    """
    model = compile_scene(registry.get(name)).model
    solid = [model.geom(i) for i in range(model.ngeom) if model.geom_contype[i] or model.geom_conaffinity[i]]
    kinds = {kind(geom.name) for geom in solid}
    assert {"right", "left", "floor"} < kinds
    for a in solid:
        for b in solid:
            if a.id >= b.id:
                continue
            meets = bool((a.contype[0] & b.conaffinity[0]) | (b.contype[0] & a.conaffinity[0]))
            same_hand = kind(a.name) == kind(b.name) and kind(a.name) in SIDES
            both_stand = {kind(a.name), kind(b.name)} == {"floor", "table"}
            inner = INNER in (a.contype[0], b.contype[0]) and {kind(a.name), kind(b.name)} & {"floor", "table"}
            assert meets == (not same_hand and not both_stand and not inner), (a.name, b.name)
    assert model.npair == 2 * 18


@pytest.mark.parametrize("name", ["CatchUnderarm", "Switch"])
def test_a_dressed_model_moves_like_the_one_that_steps(name):
    scene = compile_scene(registry.get(name, True))
    plain, dressed = scene.model, scene.dressed
    assert plain.nmesh == 0 and dressed.nmesh > 10
    solid = [[m.geom(i).name for i in range(m.ngeom) if m.geom_contype[i]] for m in (plain, dressed)]
    assert solid[0] == solid[1]
    for field in ("body_mass", "body_inertia", "body_parentid", "jnt_bodyid", "jnt_axis", "body_pos", "body_mocapid"):
        assert np.array_equal(getattr(plain, field), getattr(dressed, field)), field
    poses = []
    for model in (plain, dressed):
        data = mujoco.MjData(model)
        data.qpos[:] = scene.start_qpos[: model.nq] + np.linspace(0.0, 0.3, model.nq)
        mujoco.mj_kinematics(model, data)
        poses.append(data.xpos.copy())
    assert np.array_equal(*poses)


def test_what_collides_of_hands_is_hidden_and_skins_lie_around_it():
    scene = compile_scene(registry.get("HandOver"))
    model = scene.dressed
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for i in range(model.ngeom):
        if model.geom(i).name.startswith(("right/", "left/")):
            assert model.geom_group[i] == 3
    for side in ("right", "left"):
        for link in ("ffproximal", "lfdistal", "thmiddle", "forearm"):
            body = model.body(f"{side}/{link}").id
            mine = [i for i in range(model.ngeom) if model.geom_bodyid[i] == body]
            solid = next(i for i in mine if model.geom_contype[i])
            skin = next(i for i in mine if model.geom_type[i] == mujoco.mjtGeom.mjGEOM_MESH)
            assert np.linalg.norm(data.geom_xpos[skin] - data.geom_xpos[solid]) < 0.03, link
            assert model.geom_rbound[skin] < 1.3 * model.geom_rbound[solid], link


@pytest.mark.parametrize("name", list(looks._meshes()))
def test_a_skin_is_closed_and_faces_outwards(name):
    points, faces = looks._meshes()[name]
    edges = Counter((int(a), int(b)) for face in faces for a, b in zip(face, np.roll(face, -1), strict=True))
    assert all(edges[b, a] == times == 1 for (a, b), times in edges.items())
    a, b, c = points[faces].transpose(1, 0, 2)
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() > 0.0

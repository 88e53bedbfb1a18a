"""Hands in pictures: the models that draw and those that step."""

from collections import Counter

import mujoco
import numpy as np
import pytest

from bidex_meta.hands import looks
from bidex_meta.tasks import registry
from bidex_meta.tasks.scene import compile_scene


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

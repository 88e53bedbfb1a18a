"""Clouds against ray casting in MuJoCo, and points on surfaces against what defines them."""

import mujoco
import numpy as np
import pytest
import torch

from bidex_meta.errors import BidexError
from bidex_meta.tasks import registry
from bidex_meta.tasks.scene import compile_scene
from bidex_meta.world.cloud import Camera, Cloud, beside, camera_of, draw
from bidex_meta.world.surfaces import FIXTURE, HAND, OBJECT, area, inside, sample, surface

_PIXELS = 96
_SHAPES = {
    "sphere": 'type="sphere" size="0.05"',
    "capsule": 'type="capsule" size="0.02 0.05"',
    "cylinder": 'type="cylinder" size="0.03 0.05"',
    "box": 'type="box" size="0.02 0.03 0.05"',
    "ellipsoid": 'type="ellipsoid" size="0.03 0.03 0.04"',
    "mesh": 'type="mesh" mesh="wedge"',
}


def one_geom(attributes: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        '<mujoco><asset><mesh name="wedge" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/></asset>'
        f"<worldbody><body><geom {attributes}/></body></worldbody></mujoco>"
    )


def rays(model: mujoco.MjModel, data: mujoco.MjData, eye: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, ...]:
    """Distance of each point from the eye, and distance and geom of what a ray to it meets first."""
    way = points - eye
    far = np.linalg.norm(way, axis=1)
    met, geom = np.zeros(len(way)), np.zeros(len(way), np.int32)
    directions = (way / far[:, None]).ravel()
    mujoco.mj_multiRay(model, data, eye, directions, None, 1, -1, geom, met, None, len(way), 10.0)
    return far, met, geom


@pytest.mark.parametrize("name", _SHAPES)
def test_points_of_a_shape_lie_on_it_evenly_and_normals_point_outward(name: str) -> None:
    model = one_geom(_SHAPES[name])
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    points, normals = surface(model, 0, 2000, np.array([0.1, 0.7]))
    turn, place = data.geom_xmat[0].reshape(3, 3), data.geom_xpos[0]
    world, out = points @ turn.T + place, normals @ turn.T
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1.0, atol=1e-9)
    # From a millimetre outside, looking back along the normal, the surface is one millimetre away.
    for point, normal in zip(world[::40], out[::40], strict=True):
        away = mujoco.mj_ray(model, data, point + 1e-3 * normal, -normal, None, 1, -1, np.zeros(1, np.int32), None)
        assert away == pytest.approx(1e-3, abs=1e-5)
    if name != "mesh":
        # Points within a millimetre of an edge are left out.
        assert inside(model, 0, points - 2e-3 * normals, 1e-3).mean() > 0.85
        assert not inside(model, 0, points + 1e-3 * normals, 0.0).any()
    # Projected area by Cauchy: points that face a direction, each weighing its area, show the shape's outline.
    eye = np.array([3.0, 0.4, 0.2])
    axis = eye / np.linalg.norm(eye)
    shown = area(model, 0) / len(points) * np.clip(out @ axis, 0.0, None).sum()
    side = np.linspace(-0.12, 0.12, 121)
    right = np.cross(axis, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    grid = (side[:, None, None] * right + side[None, :, None] * np.cross(axis, right)).reshape(-1, 3) + place
    hits = [
        mujoco.mj_ray(model, data, start, -axis, None, 1, -1, np.zeros(1, np.int32), None) >= 0.0
        for start in grid + axis
    ]
    assert shown == pytest.approx(np.mean(hits) * 0.24**2, rel=0.04)


def test_the_same_seed_gives_the_same_points_and_too_few_are_refused() -> None:
    model = compile_scene(registry.get("HandOver")).model
    first, again, other = (sample(model, 400, seed).points for seed in (0, 0, 1))
    assert np.array_equal(first, again) and not np.array_equal(first, other) and len(first) == 400
    with pytest.raises(BidexError, match="at least"):
        sample(model, 10)


@pytest.mark.parametrize("name", registry.names())
def test_a_cloud_lies_on_what_a_camera_sees(name: str) -> None:
    task = registry.get(name)
    model = compile_scene(task).model
    data, camera = mujoco.MjData(model), camera_of(task)
    eye = np.array(camera.eye)
    cloud = Cloud(sample(model, 3072), camera, 768)
    random = np.random.default_rng(0)
    for bent in (0.0, 0.4, 0.8):
        mujoco.mj_resetData(model, data)
        for joint in range(model.njnt):
            if model.jnt_limited[joint] and model.joint(joint).name.startswith(("right/", "left/")):
                low, high = model.jnt_range[joint]
                data.qpos[model.jnt_qposadr[joint]] = low + bent * random.random() * (high - low) if bent else 0.0
        mujoco.mj_forward(model, data)
        poses = torch.tensor(data.xpos)[None], torch.tensor(data.xmat).view(1, -1, 3, 3)
        points = cloud(*poses)[0].double().numpy()
        far, met, geom = rays(model, data, eye, points)
        assert (np.abs(far - met) < 0.005).mean() >= 0.95
        # Every body of an object that covers more than a hundredth of the image has points.
        at = (np.arange(_PIXELS) + 0.5) / _PIXELS - 0.5
        across, down = (x.ravel()[:, None] / camera.focal for x in np.meshgrid(at, at))
        right, below, forward = camera.axes
        shown = rays(model, data, eye, eye + forward + across * right + down * below)[2]
        body = np.where(shown >= 0, model.geom_bodyid[np.maximum(shown, 0)], 0)
        large = {int(b) for b in np.unique(body) if b > 0 and (body == b).mean() > 0.01}
        assert large <= set(model.geom_bodyid[geom[geom >= 0]].tolist())


def test_a_wall_hides_and_without_it_nothing_does() -> None:
    def scene(wall: str) -> tuple[mujoco.MjModel, torch.Tensor]:
        model = mujoco.MjModel.from_xml_string(
            f'<mujoco><worldbody><body pos="0 0 0"><geom type="sphere" size="0.1"/></body>{wall}</worldbody></mujoco>'
        )
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        cloud = Cloud(sample(model, 3072), Camera((1.0, 0.0, 0.0), (0.0, 0.0, 0.0)), 256)
        return model, cloud(torch.tensor(data.xpos)[None], torch.tensor(data.xmat).view(1, -1, 3, 3))[0]

    _, free = scene("")
    assert (free[:, 0] > 0.0).all() and (free.norm(dim=1) - 0.1).abs().max() < 1e-5
    _, hidden = scene('<body pos="0.3 0 0"><geom type="box" size="0.01 0.2 0.2"/></body>')
    assert (hidden[:, 0] > 0.28).all()
    _, behind = scene('<body pos="-0.3 0 0"><geom type="box" size="0.01 0.05 0.05"/></body>')
    assert (behind[:, 0] > 0.0).all()


_CAMERA = Camera((1.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def middle(*points: tuple[float, float, float, float]) -> list[int]:
    return draw(np.array(points), _CAMERA, 41, 41)[20, 20].tolist()


def test_a_point_is_drawn_where_the_camera_sees_it() -> None:
    picture = draw(np.array([[0.0, 0.2, 0.1, HAND]]), _CAMERA, 200, 100)
    rows, columns = (picture != picture[0, 0]).any(axis=2).nonzero()
    # At a distance of 1, the width of the image is 2 tan 30 deg, which is 100 pixels on the smaller side.
    assert abs(columns.mean() - (100 + 0.2 * _CAMERA.focal * 100)) < 1.0
    assert abs(rows.mean() - (50 - 0.1 * _CAMERA.focal * 100)) < 1.0


def test_the_nearer_point_is_in_front_whatever_the_order() -> None:
    near, far = (0.2, 0.0, 0.0, OBJECT), (-0.2, 0.0, 0.0, HAND)
    assert middle(near, far) == middle(far, near)
    alone = middle((0.2, 0.0, 0.0, OBJECT))
    assert alone == middle(near, far) != middle(far)


def test_nothing_seen_is_an_empty_picture() -> None:
    behind = draw(np.array([[2.0, 0.0, 0.0, FIXTURE], [np.nan, 0.0, 0.0, HAND]]), _CAMERA, 20, 10)
    assert behind.shape == (10, 20, 3) and (behind == behind[0, 0]).all()


def test_from_the_side_it_looks_at_the_same_place_from_as_far() -> None:
    side = beside(_CAMERA)
    assert side.target == _CAMERA.target
    assert abs(float(np.linalg.norm(np.subtract(side.eye, side.target))) - 1.0) < 0.01
    assert abs(side.axes[2] @ _CAMERA.axes[2]) < 0.01


def test_a_camera_may_look_straight_down() -> None:
    axes = Camera((0.0, -0.6, 1.8), (0.0, -0.6, 0.5)).axes
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(axes[2], (0.0, 0.0, -1.0))

"""Pictures of clouds: each point where the camera sees it, the nearer one in front."""

import numpy as np

from bidex_meta.points.cloud import Camera
from bidex_meta.points.pictures import beside, draw
from bidex_meta.points.surfaces import FIXTURE, HAND, OBJECT

_CAMERA = Camera((1.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def middle(*points: tuple[float, float, float, float]) -> list[int]:
    return draw(np.array(points), _CAMERA, 41, 41)[20, 20].tolist()


def test_a_point_is_drawn_where_the_camera_sees_it() -> None:
    picture = draw(np.array([[0.0, 0.2, 0.1, HAND]]), _CAMERA, 200, 100)
    rows, columns = (picture != picture[0, 0]).any(axis=2).nonzero()
    # A width of the image is 2 tan 30 deg at a distance of 1: 100 pixels, the smaller side.
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

"""Rotations against SciPy's."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from bidex_meta.utils import maths

angles = st.floats(-math.pi, math.pi)
unit = st.floats(-1.0, 1.0)
vectors = hnp.arrays(np.float64, (4, 3), elements=st.floats(-10.0, 10.0))
quaternions = hnp.arrays(np.float64, (4, 4), elements=unit).filter(lambda q: (np.linalg.norm(q, axis=1) > 0.1).all())


def normal(q: np.ndarray) -> tuple[torch.Tensor, Rotation]:
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    return torch.from_numpy(q), Rotation.from_quat(q)


@given(quaternions, quaternions, vectors, vectors)
def test_products_inverses_and_turned_vectors(a: np.ndarray, b: np.ndarray, v: np.ndarray, w: np.ndarray) -> None:
    (p, first), (q, second), x, y = normal(a), normal(b), torch.from_numpy(v), torch.from_numpy(w)
    np.testing.assert_allclose(maths.multiply(p, q).numpy(), (first * second).as_quat(), atol=1e-12)
    np.testing.assert_allclose(maths.multiply(p[0], q).numpy(), (first[0] * second).as_quat(), atol=1e-12)
    np.testing.assert_allclose(maths.multiply(q, maths.conjugate(q)).numpy(), [[0, 0, 0, 1]] * 4, atol=1e-12)
    np.testing.assert_allclose(maths.rotate(q, x).numpy(), second.apply(v), atol=1e-9)
    np.testing.assert_allclose(maths.rotate(q, x[0]).numpy(), second.apply(v[0]), atol=1e-9)
    np.testing.assert_allclose(maths.rotate(q[0], x).numpy(), second[0].apply(v), atol=1e-9)
    np.testing.assert_allclose(maths.norm(x).numpy(), np.linalg.norm(v, axis=1), rtol=1e-12)
    np.testing.assert_allclose(maths.dot(x, y).numpy(), np.einsum("ij,ij->i", v, w), atol=1e-10)
    np.testing.assert_allclose(maths.wxyz(q).numpy(), second.as_quat(scalar_first=True), atol=1e-15)
    np.testing.assert_array_equal(maths.xyzw(maths.wxyz(q)).numpy(), q.numpy())


@given(quaternions)
def test_rotation_angle(a: np.ndarray) -> None:
    q, turn = normal(a)
    found = maths.rotation_angle(q).numpy()
    np.testing.assert_allclose(found, turn.magnitude(), atol=1e-12)
    printed = 2.0 * np.arcsin(np.minimum(1.0, np.linalg.norm(q.numpy()[:, :3], axis=1)))
    np.testing.assert_allclose(found, printed, atol=1e-6)


@given(st.floats(1e-9, 1e-2), st.booleans(), hnp.arrays(np.float64, 3, elements=unit))
def test_rotation_angle_near_its_ends(small: float, near_pi: bool, axis: np.ndarray) -> None:
    axis = (axis if np.linalg.norm(axis) > 0.1 else np.ones(3)) / max(np.linalg.norm(axis), 0.1)
    axis /= np.linalg.norm(axis)
    angle = math.pi - small if near_pi else small
    for sign in (1.0, -1.0):
        q = sign * np.append(math.sin(angle / 2) * axis, math.cos(angle / 2))
        assert float(maths.rotation_angle(torch.from_numpy(q))) == pytest.approx(angle, abs=1e-12)
        single = maths.rotation_angle(torch.from_numpy(q).float())
        assert float(single) == pytest.approx(angle, abs=1e-6), "arcsin would lose half the digits here"
    beyond = maths.rotation_angle(torch.tensor([0.0, 0.0, 1.0, -1e-12], dtype=torch.float64))
    assert 0.0 <= float(beyond) <= math.pi


def test_rotation_angle_has_a_finite_slope_at_half_a_turn() -> None:
    q = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    maths.rotation_angle(q).backward()
    assert q.grad is not None and q.grad.isfinite().all()


@given(st.lists(st.tuples(angles, st.floats(-1.5, 1.5), angles), min_size=1, max_size=5))
def test_roll_pitch_yaw(rpy: list[tuple[float, float, float]]) -> None:
    turn = Rotation.from_euler("xyz", np.array(rpy))
    found = maths.roll_pitch_yaw(torch.from_numpy(turn.as_quat())).numpy()
    assert (np.abs(found) <= math.pi + 1e-12).all()
    np.testing.assert_allclose(Rotation.from_euler("xyz", found).as_matrix(), turn.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * np.array(rpy)), atol=1e-7)
    flipped = maths.roll_pitch_yaw(torch.from_numpy(-turn.as_quat())).numpy()
    np.testing.assert_allclose(np.exp(1j * flipped), np.exp(1j * found), atol=1e-12)


def test_roll_pitch_yaw_survives_a_vertical_pitch() -> None:
    q = torch.from_numpy(Rotation.from_euler("xyz", [0.0, math.pi / 2, 0.0]).as_quat() * (1 + 1e-12))
    assert maths.roll_pitch_yaw(q).isfinite().all()


@given(hnp.arrays(np.float64, (5, 2), elements=unit))
def test_random_orientation(u: np.ndarray) -> None:
    """Turn by pi u0 about x, on the left, times turn by pi u1 about y (docs/figures.md, start noise)."""
    found = maths.random_orientation(*torch.from_numpy(u).unbind(1))
    assert found.dtype == torch.float64
    x, y = (Rotation.from_rotvec(np.pi * u[:, [i]] * np.eye(3)[i]) for i in (0, 1))
    np.testing.assert_allclose(found.numpy(), (x * y).as_quat(), atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(found.numpy(), axis=1), 1.0, atol=2e-7)


@given(st.tuples(angles, angles, angles), st.tuples(angles, angles, angles))
def test_plain_quaternions(a: tuple[float, float, float], b: tuple[float, float, float]) -> None:
    first, second = Rotation.from_euler("xyz", a), Rotation.from_euler("xyz", b)
    p, q = maths.quaternion_from_rpy(a), maths.quaternion_from_rpy(b)
    turn = Rotation.from_euler("ZYX", a[::-1])
    np.testing.assert_allclose(Rotation.from_quat(p, scalar_first=True).as_matrix(), turn.as_matrix(), atol=1e-12)
    product = Rotation.from_quat(maths.quaternion_product(p, q), scalar_first=True)
    np.testing.assert_allclose(product.as_matrix(), (first * second).as_matrix(), atol=1e-12)

"""Batched rotations on torch tensors, quaternions (x, y, z, w).

Sums over the three or four components are written out term by term. The order in which a library's reduction adds may
depend on the batch size, but an environment's results must not depend on the number of environments.
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from bidex_meta.errors import BidexError


def check_precision() -> None:
    """Raise BidexError unless torch's default dtype is float32, which observations and networks use."""
    kind = torch.get_default_dtype()
    if kind != torch.float32:
        raise BidexError(
            f"Expected torch's default dtype to be torch.float32, got {kind}. Call "
            "torch.set_default_dtype(torch.float32), and give your own tensors their dtype."
        )


def constant(values: Sequence[float] | Sequence[Sequence[float]], like: Tensor) -> Tensor:
    """Return fixed numbers, or nested tuples of numbers, as a read-only tensor with the dtype and device of ``like``.

    The tensor is copied to the device once: a copy in every step would make the host wait for the device.
    """
    return _constant(values, like.dtype, like.device)


def indices(values: Sequence[int], like: Tensor) -> Tensor:
    """Return fixed indices as a read-only int64 tensor on the device of ``like``; they are copied there only once."""
    return _constant(tuple(values), torch.int64, like.device)


@lru_cache(maxsize=1024)
def _constant(values: Sequence[float] | Sequence[Sequence[float]], dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=dtype, device=device)


def xyzw(wxyz: Tensor) -> Tensor:
    """Convert MuJoCo's (w, x, y, z) to (x, y, z, w). Shape (..., 4)."""
    return wxyz.roll(-1, dims=-1)


def wxyz(xyzw: Tensor) -> Tensor:
    """Convert (x, y, z, w) to MuJoCo's (w, x, y, z). Shape (..., 4)."""
    return xyzw.roll(1, dims=-1)


# The product a b is a_w b + a_x (b_w, -b_z, b_y, -b_x) + a_y (b_z, b_w, -b_x, -b_y) + a_z (-b_y, b_x, b_w, -b_z).
_PRODUCT = (0, 1, 2, 3, 3, 2, 1, 0, 2, 3, 0, 1, 1, 0, 3, 2)
_PRODUCT_SIGNS = (1, 1, 1, 1, 1, -1, 1, -1, 1, 1, -1, -1, -1, 1, 1, -1)


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Return the Hamilton product a b of (x, y, z, w) quaternions. Shapes (..., 4), broadcast.

    Whole columns are multiplied at a time, in 9 operations instead of 33. For few rows the number of operations decides
    the time.
    """
    turned = b.index_select(-1, indices(_PRODUCT, b)) * constant(_PRODUCT_SIGNS, b)
    of_w, of_x, of_y, of_z = turned.unflatten(-1, (4, 4)).unbind(-2)
    x, y, z, w = a.unsqueeze(-1).unbind(-2)
    return w * of_w + x * of_x + y * of_y + z * of_z


def conjugate(q: Tensor) -> Tensor:
    """Return the inverse rotation of a unit quaternion (x, y, z, w). Shape (..., 4)."""
    return q * constant((-1.0, -1.0, -1.0, 1.0), q)


def norm(v: Tensor) -> Tensor:
    """Return the Euclidean length over the last axis of size 3. Shape (..., 3) to (...)."""
    xx, yy, zz = (v * v).unbind(-1)
    return (xx + yy + zz).sqrt()


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Return the scalar product over the last axis of size 3. Shapes (..., 3), broadcast."""
    x, y, z = (a * b).unbind(-1)
    return x + y + z


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """Rotate the vector v, shape (..., 3), by the unit quaternion q (x, y, z, w), shape (..., 4)."""
    axis = q[..., :3]
    w = q[..., 3:]
    axis, v = torch.broadcast_tensors(axis, v)
    t = 2.0 * torch.linalg.cross(axis, v)
    return v + w * t + torch.linalg.cross(axis, t)


def rotation_angle(q: Tensor) -> Tensor:
    """Return the angle of a unit quaternion (x, y, z, w) in [0, pi]: 2 atan2(|v|, |w|).

    The result equals 2 arcsin(min(|v|, 1)), the formula of the paper, but its slope stays finite near pi.
    """
    return 2.0 * torch.atan2(norm(q[..., :3]), q[..., 3].abs())


def uprightness(q: Tensor) -> Tensor:
    """Return the cosine of the angle between a body's z axis and the vertical.

    ``q`` (..., 4) is the body's orientation (x, y, z, w); the result has the shape (...).
    """
    x, y, _, _ = q.unbind(-1)
    return 1.0 - 2.0 * (x * x + y * y)


# These are halves of the terms of the three angles, as sums of two products: wx + yz, xx + yy, wy - zx, wz + xy, yy +
# zz.
_ANGLES = ((3, 1, 0, 1, 3, 2, 3, 0, 1, 2), (0, 2, 0, 1, 1, 0, 2, 1, 1, 2))
_ANGLE_SIGNS = (1, 1, 1, 1, 1, -1, 1, 1, 1, 1)


def roll_pitch_yaw(q: Tensor) -> Tensor:
    """Return roll, pitch, yaw (rad) of R = Rz(yaw) Ry(pitch) Rx(roll), in (-pi, pi]. Shape (..., 4) to (..., 3)."""
    left, right = (q.index_select(-1, indices(columns, q)) for columns in _ANGLES)
    first, second = (left * right * constant(_ANGLE_SIGNS, q)).unflatten(-1, (5, 2)).unbind(-1)
    sin_roll, out_roll, sin_pitch, sin_yaw, out_yaw = (2.0 * (first + second)).unbind(-1)
    pitch = torch.asin(sin_pitch.clamp(-1.0, 1.0))
    return torch.stack((torch.atan2(sin_roll, 1.0 - out_roll), pitch, torch.atan2(sin_yaw, 1.0 - out_yaw)), dim=-1)


def random_orientation(u0: Tensor, u1: Tensor) -> Tensor:
    """Return the rotation by pi u0 about x times the rotation by pi u1 about y, from draws (n,) in [-1, 1].

    Source: docs/figures.md, start noise. Returns quaternions (x, y, z, w), shape (n, 4), rounded to single precision.
    In double precision, sines that a CPU computes as vectors and those that it computes one by one at the end of a
    batch may differ in the last bit, but a start must not depend on its position in the batch.
    """
    a = 0.5 * math.pi * u0
    b = 0.5 * math.pi * u1
    sa = a.sin()
    ca = a.cos()
    sb = b.sin()
    cb = b.cos()
    return torch.stack((sa * cb, ca * sb, sa * sb, ca * cb), dim=-1).float().to(u0.dtype)


def quaternion_from_rpy(rpy: Sequence[float]) -> tuple[float, float, float, float]:
    """Return the quaternion (w, x, y, z) of R = Rz(yaw) Ry(pitch) Rx(roll); angles in rad.

    The function works on plain numbers, for poses in scenes.
    """
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(0.5 * a), math.sin(0.5 * a)) for a in rpy)
    return (
        cy * cp * cr + sy * sp * sr,
        cy * cp * sr - sy * sp * cr,
        cy * sp * cr + sy * cp * sr,
        sy * cp * cr - cy * sp * sr,
    )


def quaternion_product(
    a: tuple[float, float, float, float], b: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    """Return the Hamilton product of two (w, x, y, z) quaternions of plain numbers.

    For one pair of quaternions, ``multiply`` on tensors takes fifty times as long.
    """
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def may_look(device: torch.device) -> bool:
    """Return whether reading a tensor's values costs nothing; on an accelerator the host would wait for the device.

    The result is False while a network is exported, because the exported code must not branch on values.
    """
    return device.type == "cpu" and not torch.compiler.is_exporting()

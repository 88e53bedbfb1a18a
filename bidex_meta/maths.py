"""Batched rotations on torch tensors.

Quaternions here are (x, y, z, w), the convention outside the engine. Sums over the three or four components are written
out term by term: a library reduction may add in another order for another batch size, and a row's numbers must not
depend on how many rows there are.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor


def constant(values: Sequence[Any], like: Tensor) -> Tensor:
    """Fixed numbers, nested tuples of them, as a tensor of another one's dtype and device. Not to be written to.

    They are brought to the device once: copied anew in every step, each would make the host wait for it.
    """
    return _constant(values, like.dtype, like.device)


def indices(values: Sequence[int], like: Tensor) -> Tensor:
    """Fixed indices on the device of a tensor, int64, brought there once. Not to be written to."""
    return _constant(tuple(values), torch.int64, like.device)


@lru_cache(maxsize=1024)
def _constant(values: Sequence[Any], dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=dtype, device=device)


def xyzw(wxyz: Tensor) -> Tensor:
    """MuJoCo's (w, x, y, z) to (x, y, z, w). Shape (..., 4)."""
    return wxyz.roll(-1, dims=-1)


def wxyz(xyzw: Tensor) -> Tensor:
    """(x, y, z, w) to MuJoCo's (w, x, y, z). Shape (..., 4)."""
    return xyzw.roll(1, dims=-1)


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product a b of (x, y, z, w) quaternions. Shapes (..., 4), broadcast."""
    ax, ay, az, aw = a.unbind(-1)
    bx, by, bz, bw = b.unbind(-1)
    return torch.stack(
        (
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ),
        dim=-1,
    )


def conjugate(q: Tensor) -> Tensor:
    """The inverse rotation of a unit quaternion (x, y, z, w). Shape (..., 4)."""
    return q * constant((-1.0, -1.0, -1.0, 1.0), q)


def norm(v: Tensor) -> Tensor:
    """Euclidean length over the last axis of size 3. Shape (..., 3) to (...)."""
    x, y, z = v.unbind(-1)
    return (x * x + y * y + z * z).sqrt()


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Scalar product over the last axis of size 3. Shapes (..., 3), broadcast."""
    ax, ay, az = a.unbind(-1)
    bx, by, bz = b.unbind(-1)
    return ax * bx + ay * by + az * bz


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """The vector v, shape (..., 3), turned by the unit quaternion q (x, y, z, w), shape (..., 4)."""
    axis, w = q[..., :3], q[..., 3:]
    axis, v = torch.broadcast_tensors(axis, v)
    t = 2.0 * torch.linalg.cross(axis, v)
    return v + w * t + torch.linalg.cross(axis, t)


def rotation_angle(q: Tensor) -> Tensor:
    """Angle of a unit quaternion (x, y, z, w) in [0, pi]: 2 atan2(|v|, |w|).

    The same value as the printed 2 arcsin(min(|v|, 1)), but its slope stays finite near pi.
    """
    return 2.0 * torch.atan2(norm(q[..., :3]), q[..., 3].abs())


def uprightness(q: Tensor) -> Tensor:
    """Cosine of the angle between a body's own z axis and the vertical, from (x, y, z, w). Shape (..., 4) to (...)."""
    x, y, _, _ = q.unbind(-1)
    return 1.0 - 2.0 * (x * x + y * y)


def roll_pitch_yaw(q: Tensor) -> Tensor:
    """Roll, pitch, yaw (rad) of R = Rz(yaw) Ry(pitch) Rx(roll), in (-pi, pi]. Shape (..., 4) to (..., 3)."""
    x, y, z, w = q.unbind(-1)
    roll = torch.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = torch.asin((2.0 * (w * y - z * x)).clamp(-1.0, 1.0))
    yaw = torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return torch.stack((roll, pitch, yaw), dim=-1)


def random_orientation(u0: Tensor, u1: Tensor) -> Tensor:
    """The paper's random orientation: a turn by pi u0 about x times a turn by pi u1 about y (sheet 3.3).

    Args:
        u0: Draws in [-1, 1], shape (n,).
        u1: Draws in [-1, 1], shape (n,).

    Returns:
        Quaternions (x, y, z, w), shape (n, 4), rounded to single precision: sines of a vector unit and of its scalar
        tail may differ in the last bit of double precision, and a row's start must not depend on its place in a batch.
    """
    a, b = 0.5 * math.pi * u0, 0.5 * math.pi * u1
    sa, ca, sb, cb = a.sin(), a.cos(), b.sin(), b.cos()
    return torch.stack((sa * cb, ca * sb, sa * sb, ca * cb), dim=-1).float().to(u0.dtype)


def quaternion_from_rpy(rpy: Sequence[float]) -> tuple[float, float, float, float]:
    """The quaternion (w, x, y, z) of R = Rz(yaw) Ry(pitch) Rx(roll); angles in rad. Plain numbers, for scene poses."""
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
    """Hamilton product of two (w, x, y, z) quaternions of plain numbers."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )

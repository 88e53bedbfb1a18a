"""Joint angles at the start of an episode, and room for an object on the hand (docs/figures.md, start noise)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from bidex_meta.hands.hand import DISTAL_PER_MIDDLE, hand
from bidex_meta.hands.poses import HandPose
from bidex_meta.utils.maths import conjugate, constant, dot, indices, norm, rotate, xyzw

_WRIST = (0.0, 0.01, 0.256)
"""Wrist origin in the mount frame, metres; the palm lies 0.034 m further along the z axis that the wrist has
turned (docs/figures.md, hand frames)."""
_PALM_OFFSET = 0.034
_PALM_HALF_THICKNESS = 0.0111
_ROOTS = ((0.033, 0.095), (0.011, 0.099), (-0.011, 0.095), (-0.034, 0.088))
"""x and z of the four fingers' roots in the palm frame, metres, from index to little finger (docs/figures.md, hand
frames)."""
_CUP_LIFT, _CUP_TILT = 0.039, 0.571
"""Rise of the little finger's root, metres, and bend of the little finger, radians, per radian of LFJ4
(docs/figures.md, hand joints)."""
_METACARPAL = ((-0.0335, 0.019, 0.040), (-0.0335, 0.033, 0.068))
"""Ends of the little finger's metacarpal in the palm frame: x, metres; rise of the outer edge per radian of LFJ4,
metres; z, metres (docs/figures.md, hand joints and hand geoms)."""
_METACARPAL_RADIUS = 0.0111
_THUMB = ((0.0339, -0.009, 0.0289), (0.1019, -0.009, 0.0969))
"""Ends of the thumb's centre line in the palm frame, metres, if all its joints are at zero (docs/figures.md, hand
geoms)."""
_THUMB_RADIUS = 0.013
_THUMB_ABOVE_PALM = _THUMB_RADIUS + 0.009 - _PALM_HALF_THICKNESS
_LENGTHS = (0.045, 0.025, 0.024)
_RADII = (0.01, 0.00805, 0.00705)
"""Lengths and radii of the fingers' proximal, middle and distal capsules, metres (docs/figures.md, hand geoms)."""
_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Positions on a link's centre line, from its joint on, at which its distance to a box is measured."""
_SLACK = 0.002
"""Overlap of object and hand that remains at a start, metres, so that contacts carry the object from the first step;
5 mm is allowed."""
_MAX_CROSSING = 0.1
"""Largest difference between the side angles of neighbouring fingers at which their tips stay apart, rad. The roots are
22 mm apart, the tips are 94 mm away from the roots and have radii of 7 mm, and 3 mm of overlap is allowed."""


_Support = Callable[[Tensor, Tensor], Tensor]
"""Function of vectors (n, ..., 3) that point to a body's origin, and of their lengths (n, ...): the extent of the body
from its origin in the opposite direction, metres."""


@dataclass(frozen=True)
class _Indices:
    side: Tensor
    base: Tensor
    middle: Tensor
    distal: Tensor
    cup: int


@lru_cache(maxsize=4)
def _indices(device: torch.device) -> _Indices:
    find = hand().index
    groups = [find(*(f"{f}J{k}" for f in ("FF", "MF", "RF", "LF"))) for k in (3, 2, 1, 0)]
    return _Indices(*(torch.tensor(group, device=device) for group in groups), cup=find("LFJ4")[0])


def noisy_joints(draws: Tensor, scale: float) -> Tensor:
    """Return noisy joint angles (n, 24), rad: clip(scale * range * u, limits).

    The draws u are in [-1, 1], shape (n, 24); the scale is a share of each joint's range. Distal joints then follow the
    middle joints, and side angles are reduced where neighbouring fingers would cross.
    """
    low, high = (constant(tuple(x.tolist()), draws) for x in (hand().low, hand().high))
    where = _indices(draws.device)
    joints = (draws * (scale * (high - low))).clamp(low, high)
    side = joints[:, where.side]
    crossing = (side[:, 1:] - side[:, :-1]).amax(dim=1, keepdim=True).clamp(min=_MAX_CROSSING)
    joints[:, where.side] = side * (_MAX_CROSSING / crossing)
    joints[:, where.distal] = torch.minimum(joints[:, where.middle] * DISTAL_PER_MIDDLE, high[where.distal])
    return joints


def make_room(joints: Tensor, position: Tensor, axis: Tensor, radius: float, half: float) -> tuple[Tensor, Tensor]:
    """Lift an egg off the palm and open the fingers that noise would push into it.

    ``joints`` (n, 24) are the joint angles, rad. ``position`` (n, 3) is the egg's centre, and ``axis`` (n, 3) is the
    unit vector along its long axis; both are in the mount frame. ``radius`` and ``half`` are the egg's short and long
    semi-axes. Returns the joint angles with opened fingers (n, 24), and the egg's shift in the mount frame (n, 3).
    Lengths are in metres. For the distances of the egg from the palm's plane and from the fingers' capsules, lower
    bounds are used. They are computed from the egg's extent (support) towards the palm or the finger.
    """
    axes = _palm_axes(joints)
    centre = _in_palm(position, joints, axes)
    axis = torch.stack([dot(axis, a) for a in axes], dim=1)
    square = half**2 - radius**2
    reach = (radius**2 + square * axis[:, 1] ** 2).sqrt()

    def support(vector: Tensor, length: Tensor) -> Tensor:
        along = axis.reshape(-1, *(1,) * (vector.dim() - 2), 3)
        return (radius**2 + square * (dot(vector, along) / length) ** 2).sqrt()

    return _clear(joints, centre, axes[1], reach, support)


def make_room_for(joints: Tensor, position: Tensor, points: Tensor, radii: Tensor) -> tuple[Tensor, Tensor]:
    """Lift an object off the palm, and open the fingers that noise would push into it; also lay the thumb flat.

    The object is the convex hull of balls. ``joints`` (n, 24) are the joint angles, rad. ``position`` (n, 3) is the
    object's origin in the mount frame. ``points`` (n, k, 3) are the balls' centres relative to the origin, turned with
    the object. ``radii`` (k,) are the balls' radii, 0 for corners. Lengths are in metres. Returns the new joint angles
    (n, 24) and the object's shift in the mount frame (n, 3). ``make_room`` does the same for an egg.
    """
    joints = joints.clone()
    thumb = indices(hand().index(*(f"THJ{k}" for k in range(5))), joints)
    joints.index_fill_(1, thumb, 0.0)
    axes = _palm_axes(joints)
    centre = _in_palm(position, joints, axes)
    points = torch.stack([dot(points, a[:, None]) for a in axes], dim=2)

    def support(vector: Tensor, length: Tensor) -> Tensor:
        towards = (-vector / length[..., None]).reshape(len(vector), -1, 3)
        return (towards @ points.transpose(1, 2) + radii).amax(dim=2).reshape(length.shape)

    reach = (points[..., 1] + radii).amax(dim=1)
    # A thumb that lies flat rises above the palm, so an object that would touch it starts higher.
    lowest = _SLACK - _PALM_HALF_THICKNESS - reach
    rest = torch.stack((centre[:, 0], centre[:, 1].minimum(lowest), centre[:, 2]), dim=1)
    low, high = (constant(end, rest).expand_as(rest) for end in _THUMB)
    length = norm(high - low)
    gap = _gap(rest, support, low, (high - low) / length[:, None], length)
    reach = reach + _THUMB_ABOVE_PALM * (gap < _THUMB_RADIUS)
    return _clear(joints, centre, axes[1], reach, support)


def meets_box(joints: Tensor, pose: HandPose, box: Tensor, half: tuple[float, float, float]) -> Tensor:
    """Return, for each of n starts, whether a finger penetrates a box by more than 2 mm. Shape (n,), bool.

    ``joints`` (n, 24) are the joint angles, rad, of a hand that starts at ``pose``. ``box`` (n, 7) holds the position,
    metres, and quaternion (x, y, z, w) of the box in each start. ``half`` are the half sizes of the box, metres. Each
    link is tested at five points on its centre line.
    """
    start, along, length = _finger_segments(joints)
    share = constant(_SHARES, joints)
    in_palm = start[..., None, :] + along[..., None, :] * (length[:, None] * share)[..., None]
    x, y, z = (axis[:, None, None, None] for axis in _palm_axes(joints))
    palm = constant(_WRIST, joints) + _PALM_OFFSET * _wrist_axis(joints)
    in_mount = palm[:, None, None, None] + in_palm[..., :1] * x + in_palm[..., 1:2] * y + in_palm[..., 2:] * z
    in_world = constant(pose.position, joints) + rotate(xyzw(constant(pose.quaternion, joints)), in_mount)
    centre, turn = box[:, None, None, None].split((3, 4), dim=-1)
    beyond = rotate(conjugate(turn), in_world - centre).abs() - constant(half, joints)
    gap = norm(beyond.clamp(min=0.0)) + beyond.amax(dim=-1).clamp(max=0.0)
    return (gap - constant(_RADII, joints)[:, None] < -_SLACK).flatten(1).any(dim=1)


def _in_palm(position: Tensor, joints: Tensor, axes: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    relative = position - constant(_WRIST, position) - _PALM_OFFSET * _wrist_axis(joints)
    return torch.stack([dot(relative, a) for a in axes], dim=1)


def _wrist_axis(joints: Tensor) -> Tensor:
    """Return the direction from the wrist to the palm in the mount frame, (n, 3)."""
    a = joints[:, 0]
    return torch.stack((a.sin(), torch.zeros_like(a), a.cos()), dim=1)


def _clear(joints: Tensor, centre: Tensor, y_axis: Tensor, reach: Tensor, support: _Support) -> tuple[Tensor, Tensor]:
    """Open the fingers that an object would touch, and compute by how much the object must be lifted off the palm.

    Returns the new joint angles (n, 24), rad, and the object's shift in the mount frame (n, 3), metres. ``centre``
    (n, 3) is the object's origin in the palm frame. ``reach`` (n,) is the object's extent from its origin towards the
    palm, metres, and ``support`` gives its extent in any direction.
    """
    lift = (reach + _PALM_HALF_THICKNESS - _SLACK + centre[:, 1]).clamp(min=0.0)
    centre = torch.stack((centre[:, 0], centre[:, 1] - lift, centre[:, 2]), dim=1)
    start, along, length = _finger_segments(joints)
    gap = _gap(centre[:, None, None], support, start, along, length)
    touched = (gap - constant(_RADII, gap) < -_SLACK).any(dim=2)
    where = _indices(joints.device)
    joints = joints.clone()
    for group in (where.base, where.middle, where.distal):
        joints[:, group] = joints[:, group].masked_fill(touched, 0.0)
    raised = touched[:, -1] | _meets_metacarpal(joints[:, where.cup], centre, support)
    joints[:, where.cup] = joints[:, where.cup].masked_fill(raised, 0.0)
    return joints, -lift[:, None] * y_axis


def _gap(centre: Tensor, support: _Support, start: Tensor, along: Tensor, length: Tensor) -> Tensor:
    """Return a lower bound of the distance between an object and line segments, metres.

    The bound is the distance from the object's origin to the nearest point of the segment, minus the object's extent
    (support) in that direction. A segment has a ``start``, a unit vector ``along`` and a ``length``.
    """
    to_centre = centre - start
    t = dot(to_centre, along).clamp(min=0.0).minimum(length)
    gap_vector = to_centre - t[..., None] * along
    distance = norm(gap_vector)
    return distance - support(gap_vector, distance)


def _meets_metacarpal(cup: Tensor, centre: Tensor, support: _Support) -> Tensor:
    """Return whether the little finger's metacarpal, lifted by the joint LFJ4, would penetrate the object, bool (n,).

    ``cup`` (n,) is the angle of LFJ4, rad.
    """
    ends = []
    for x, rise, z in _METACARPAL:
        ends.append(torch.stack((torch.full_like(cup, x), -rise * cup, torch.full_like(cup, z)), dim=1))
    low, high = ends
    length = norm(high - low)
    along = (high - low) / length[:, None]
    return _gap(centre, support, low, along, length) < _METACARPAL_RADIUS - _SLACK


def _palm_axes(joints: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    sa = joints[:, 0].sin()
    ca = joints[:, 0].cos()
    sb = joints[:, 1].sin()
    cb = joints[:, 1].cos()
    zero = torch.zeros_like(sa)
    return (
        torch.stack((ca, zero, -sa), dim=1),
        torch.stack((sa * sb, cb, ca * sb), dim=1),
        torch.stack((sa * cb, -sb, ca * cb), dim=1),
    )


def _sums_along(bones: Tensor) -> Tensor:
    """Return the cumulative sums over a finger's three bones, the third axis.

    In deterministic mode torch refuses ``cumsum`` of floats on a GPU.
    """
    first, second, third = bones.unbind(dim=2)
    return torch.stack((first, first + second, first + second + third), dim=2)


def _finger_segments(joints: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the centre lines of the fingers' capsules, palm frame: starts, directions (n, 4, 3, 3), lengths (3,)."""
    where = _indices(joints.device)
    side = joints[:, where.side]
    bend = torch.stack([joints[:, g] for g in (where.base, where.middle, where.distal)], dim=2)
    bend[:, -1, 0] += _CUP_TILT * joints[:, where.cup]
    bend = _sums_along(bend)
    sin = bend.sin()
    cos = bend.cos()
    along = torch.stack((side.sin()[..., None] * cos, -sin, side.cos()[..., None] * cos), dim=3)
    length = constant(_LENGTHS, joints)
    ends = _sums_along(along * length[:, None])
    roots = constant(tuple((x, 0.0, z) for x, z in _ROOTS), joints).repeat(len(joints), 1, 1)
    roots[:, -1, 1] = -_CUP_LIFT * joints[:, where.cup]
    start = roots[:, :, None] + torch.cat((torch.zeros_like(ends[:, :, :1]), ends[:, :, :-1]), dim=2)
    return start, along, length

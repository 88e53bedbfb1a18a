"""Points with normals on the visible surfaces of a scene, fixed to its bodies. Point clouds are drawn from them.

Even coverage comes from the additive recurrence R2 (Roberts 2018, "The Unreasonable Effectiveness of Quasirandom
Sequences").
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from bidex_meta.errors import BidexError
from bidex_meta.hands.hand import SIDES

Surface = tuple[np.ndarray, np.ndarray]
"""Points (n, 3) in metres and outward unit normals (n, 3), in the geom's frame."""
_PLASTIC = 1.32471795724474602596
_STEP = np.array([1.0 / _PLASTIC, 1.0 / _PLASTIC**2])
_Kind = mujoco.mjtGeom
_SPHERE = int(_Kind.mjGEOM_SPHERE)
_ELLIPSOID = int(_Kind.mjGEOM_ELLIPSOID)
_CAPSULE = int(_Kind.mjGEOM_CAPSULE)
_CYLINDER = int(_Kind.mjGEOM_CYLINDER)
_BOX = int(_Kind.mjGEOM_BOX)
_MESH = int(_Kind.mjGEOM_MESH)
DRAWN = frozenset((_SPHERE, _ELLIPSOID, _CAPSULE, _CYLINDER, _BOX, _MESH))
"""Types of geoms that have a surface here: all but planes and height fields."""


def even_numbers(count: int, offset: np.ndarray) -> np.ndarray:
    """Return evenly spread pairs in [0, 1), shape (count, 2), from an offset (2,)."""
    return (offset + np.arange(1, count + 1)[:, None] * _STEP) % 1.0


def area(model: mujoco.MjModel, geom: int) -> float:
    """Return the area of a geom's surface, m²; for an ellipsoid the error is up to 1.1 % (Thomsen's formula)."""
    a, b, c = (float(x) for x in model.geom_size[geom])
    p = 1.6075
    kind = int(model.geom_type[geom])
    if kind == _MESH:
        return float(_faces(model, geom)[1].sum())
    return {
        _SPHERE: 4.0 * np.pi * a * a,
        _CAPSULE: 4.0 * np.pi * a * (a + b),
        _CYLINDER: 2.0 * np.pi * a * (a + 2.0 * b),
        _BOX: 8.0 * (a * b + b * c + c * a),
        _ELLIPSOID: 4.0 * np.pi * float((((a * b) ** p + (b * c) ** p + (c * a) ** p) / 3.0) ** (1.0 / p)),
    }[kind]


def surface(model: mujoco.MjModel, geom: int, count: int, offset: np.ndarray) -> Surface:
    """Return points with normals, spread evenly over the surface of a geom whose type is in ``DRAWN``.

    ``offset``, (2,) in [0, 1), is the start of the sequence of ``even_numbers``.
    """
    size = np.asarray(model.geom_size[geom], dtype=np.float64)
    kind = int(model.geom_type[geom])
    if kind == _SPHERE:
        size = np.repeat(size[:1], 3)
    if kind in (_SPHERE, _ELLIPSOID):
        return _ellipsoid(size, count, offset)
    u = even_numbers(count, offset)
    if kind in _OF_UNIT:
        return _OF_UNIT[kind](size, u)
    return _mesh(model, geom, u)


def inside(model: mujoco.MjModel, geom: int, points: np.ndarray, margin: float) -> np.ndarray:
    """Return whether points (n, 3), given in a geom's frame, lie deeper than ``margin`` (m) inside the geom, bool (n,).

    Meshes are treated as if they contained no point.
    """
    size = np.asarray(model.geom_size[geom], dtype=np.float64)
    kind = int(model.geom_type[geom])
    if kind == _SPHERE:
        return np.asarray(np.linalg.norm(points, axis=1) < size[0] - margin)
    if kind == _ELLIPSOID:
        return np.asarray(np.linalg.norm(points / (size - margin), axis=1) < 1.0)
    across = np.linalg.norm(points[:, :2], axis=1)
    along = np.abs(points[:, 2])
    if kind == _CAPSULE:
        return np.hypot(across, np.maximum(along - size[1], 0.0)) < size[0] - margin
    if kind == _CYLINDER:
        return (across < size[0] - margin) & (along < size[1] - margin)
    if kind == _BOX:
        return np.asarray((np.abs(points) < size - margin).all(axis=1))
    return np.zeros(len(points), dtype=bool)


def _sphere(u: np.ndarray) -> np.ndarray:
    z = 2.0 * u[:, 0] - 1.0
    turn = 2.0 * np.pi * u[:, 1]
    across = np.sqrt(1.0 - z * z)
    return np.stack((across * np.cos(turn), across * np.sin(turn), z), axis=1)


def _ellipsoid(size: np.ndarray, count: int, offset: np.ndarray) -> Surface:
    # Stretching a sphere's points makes them too dense at the ends. Each point is kept with a probability in proportion
    # to the local stretch.
    tries = 4 * count + 64
    unit = _sphere(even_numbers(tries, offset))
    stretch = np.linalg.norm(unit / size, axis=1)
    chance = (np.arange(tries) * 0.6180339887498949 + offset[0]) % 1.0
    kept = unit[chance * stretch.max() < stretch]
    unit = kept[np.arange(count) % len(kept)]
    normals = unit / size
    return unit * size, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _capsule(size: np.ndarray, u: np.ndarray) -> Surface:
    # By Archimedes' theorem, the caps' area equals that of the enclosing cylinder, so the height is uniform over the
    # whole length.
    radius = size[0]
    half = size[1]
    height = (2.0 * u[:, 0] - 1.0) * (half + radius)
    z = np.sign(height) * np.maximum(np.abs(height) - half, 0.0) / radius
    across = np.sqrt(np.maximum(1.0 - z * z, 0.0))
    turn = 2.0 * np.pi * u[:, 1]
    normals = np.stack((across * np.cos(turn), across * np.sin(turn), z), axis=1)
    points = radius * normals
    points[:, 2] += np.clip(height, -half, half)
    return points, normals


def _cylinder(size: np.ndarray, u: np.ndarray) -> Surface:
    radius = size[0]
    half = size[1]
    side = 2.0 * half / (2.0 * half + radius)
    turn = 2.0 * np.pi * u[:, 1]
    circle = np.stack((np.cos(turn), np.sin(turn)), axis=1)
    on_side = u[:, 0] < side
    rest = (u[:, 0] - side) / (1.0 - side)  # in [0, 1): the two discs, one after the other
    end = np.where(rest < 0.5, -1.0, 1.0)
    share = 2.0 * rest % 1.0
    points = np.empty((len(u), 3))
    points[:, :2] = radius * circle * np.where(on_side, 1.0, np.sqrt(share))[:, None]
    points[:, 2] = np.where(on_side, (2.0 * u[:, 0] / side - 1.0) * half, end * half)
    normals = np.zeros_like(points)
    normals[on_side, :2] = circle[on_side]
    normals[~on_side, 2] = end[~on_side]
    return points, normals


def _box(size: np.ndarray, u: np.ndarray) -> Surface:
    areas = np.array([size[1] * size[2], size[2] * size[0], size[0] * size[1]])
    ends = np.cumsum(np.repeat(areas, 2)) / (2.0 * areas.sum())
    face = np.minimum(np.searchsorted(ends, u[:, 0], side="right"), 5)
    starts = np.concatenate(([0.0], ends[:-1]))
    first = (u[:, 0] - starts[face]) / (ends - starts)[face]
    axis = face // 2
    sign = 1.0 - 2.0 * (face % 2)
    rows = np.arange(len(u))
    points = np.empty((len(u), 3))
    normals = np.zeros((len(u), 3))
    normals[rows, axis] = sign
    for step, value in ((1, first), (2, u[:, 1])):
        other = (axis + step) % 3
        points[rows, other] = (2.0 * value - 1.0) * size[other]
    points[rows, axis] = sign * size[axis]
    return points, normals


def _faces(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return corners (f, 3, 3), areas (f,) and unit normals (f, 3) of a mesh geom's triangles that have an area."""
    mesh = int(model.geom_dataid[geom])
    first = model.mesh_vertadr[mesh]
    count = model.mesh_vertnum[mesh]
    vertices = np.asarray(model.mesh_vert[first : first + count], dtype=np.float64)
    first = model.mesh_faceadr[mesh]
    count = model.mesh_facenum[mesh]
    corners = vertices[model.mesh_face[first : first + count]]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(cross, axis=1)
    real = length > 0.0
    return corners[real], 0.5 * length[real], cross[real] / length[real, None]


def _mesh(model: mujoco.MjModel, geom: int, u: np.ndarray) -> Surface:
    corners, areas, normals = _faces(model, geom)
    ends = np.cumsum(areas) / areas.sum()
    face = np.minimum(np.searchsorted(ends, u[:, 0], side="right"), len(ends) - 1)
    starts = np.concatenate(([0.0], ends[:-1]))
    root = np.sqrt((u[:, 0] - starts[face]) / (ends - starts)[face])[:, None]
    a, b, c = corners[face].transpose(1, 0, 2)
    second = u[:, 1:]
    return (1.0 - root) * a + root * (1.0 - second) * b + root * second * c, normals[face]


_OF_UNIT = {_CAPSULE: _capsule, _CYLINDER: _cylinder, _BOX: _box}

FIXTURE, HAND, OBJECT = -1.0, 0.0, 1.0
"""Kinds of points: on things that stand still during an episode, on either hand, on things that physics moves."""
_SHARES = {HAND: 0.5, OBJECT: 0.35, FIXTURE: 0.15}
"""Share of the candidates that each kind gets. If candidates were spread by area alone, a table would leave only a
handful of points for an egg."""
_SHOWN_GROUPS = 3
"""MuJoCo's viewers draw geoms of groups 0 to 2."""
_PROBES = 512
_BURIED = 5e-4
"""Points that lie deeper than this in another geom of the same body, metres, are never seen."""


@dataclass(frozen=True)
class Surfaces:
    """P points that are fixed to bodies; the points of a body are adjacent.

    ``bodies`` (k,) are the bodies with points, ascending, and ``ends`` (k,) are the indices after each body's last
    point. ``points`` (metres) and outward unit ``normals`` are (P, 3), in the body's frame. ``kinds`` (FIXTURE, HAND or
    OBJECT) and ``geoms`` are (P,).
    """

    bodies: np.ndarray
    ends: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    kinds: np.ndarray
    geoms: np.ndarray


def visible_geoms(model: mujoco.MjModel) -> list[int]:
    """Return the geoms that a camera can see.

    Their type is in ``DRAWN``, they are in a group that MuJoCo's viewers show, and they are not fully transparent.
    """
    geoms = []
    for geom in range(model.ngeom):
        material = model.geom_matid[geom]
        opacity = model.mat_rgba[material, 3] if material >= 0 else model.geom_rgba[geom, 3]
        if int(model.geom_type[geom]) in DRAWN and model.geom_group[geom] < _SHOWN_GROUPS and opacity > 0.0:
            geoms.append(geom)
    return geoms


def body_kinds(model: mujoco.MjModel) -> list[float]:
    """Return FIXTURE, HAND or OBJECT for each body.

    A body is a fixture if it belongs to no kinematic tree, that is, if no joint lies between it and the world.
    """
    hands = tuple(f"{side}/" for side in SIDES)
    moving = [OBJECT if tree >= 0 else FIXTURE for tree in model.body_treeid]
    return [HAND if model.body(i).name.startswith(hands) else kind for i, kind in enumerate(moving)]


def sample(model: mujoco.MjModel, count: int, seed: int = 0) -> Surfaces:
    """Spread ``count`` points over a model's visible surfaces.

    Hands, objects and fixtures have fixed shares of the points; within each of these groups, points are in proportion
    to area. Raises BidexError if no geom is visible, or if there are fewer points than visible geoms.
    """
    geoms = visible_geoms(model)
    if not 0 < len(geoms) <= count:
        raise BidexError(f"Expected at least {len(geoms) or 'a geom and as many'} points, one per geom, got {count}.")
    rng = np.random.default_rng(seed)
    offsets = {geom: rng.random(2) for geom in geoms}
    # The share of a geom's probes that other geoms of its body do not bury tells its open area.
    num_open = {}
    for geom in geoms:
        points, _ = _in_body(model, geom, _PROBES, offsets[geom], geoms)
        num_open[geom] = len(points)
    open_area = np.array([area(model, geom) * num_open[geom] / _PROBES for geom in geoms])
    # Only geoms that belong to the world itself use the fixtures' share. A door's frame takes its points from the
    # objects' share.
    kinds_of_bodies = np.array(body_kinds(model))
    owners = model.geom_bodyid[geoms]
    shares = np.full(len(owners), OBJECT)
    shares[kinds_of_bodies[owners] == HAND] = HAND
    shares[owners == 0] = FIXTURE
    numbers = dict(zip(geoms, _portions(open_area, shares, count), strict=True))
    points_of_geoms = []
    normals_of_geoms = []
    of_geom = []
    for geom in sorted(geoms, key=lambda geom: (model.geom_bodyid[geom], geom)):
        number = numbers[geom]
        tries = 0
        if num_open[geom]:
            tries = int(np.ceil(1.3 * number * _PROBES / num_open[geom])) + 8
        points, normals = _in_body(model, geom, tries, offsets[geom], geoms)
        points_of_geoms.append(points[:number])
        normals_of_geoms.append(normals[:number])
        of_geom += [geom] * len(points[:number])
    bodies, counts = np.unique(model.geom_bodyid[of_geom], return_counts=True)
    return Surfaces(
        bodies=bodies,
        ends=np.cumsum(counts),
        points=np.concatenate(points_of_geoms),
        normals=np.concatenate(normals_of_geoms),
        kinds=kinds_of_bodies[model.geom_bodyid[of_geom]],
        geoms=np.array(of_geom),
    )


def _portions(areas: np.ndarray, kinds: np.ndarray, count: int) -> np.ndarray:
    """Return the number of points of each geom, (geoms,); the sum is ``count``.

    ``areas`` (m²) leave out what is buried in other geoms. A geom with an area gets at least one point,
    unless ``count`` is hardly larger than the number of geoms.
    """
    shares = np.zeros(len(areas))
    for kind, share in _SHARES.items():
        if (whole := areas[kinds == kind].sum()) > 0.0:
            shares[kinds == kind] = share * areas[kinds == kind] / whole
    wanted = np.maximum(shares / shares.sum() * count, (areas > 0.0).astype(float))
    wanted *= count / wanted.sum()
    whole = np.floor(wanted).astype(int)
    whole[np.argsort(whole - wanted, kind="stable")[: count - whole.sum()]] += 1
    return whole


def _in_body(
    model: mujoco.MjModel, geom: int, count: int, offset: np.ndarray, others: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return points and normals in the frame of a geom's body, without those buried in the body's other geoms."""
    points, normals = surface(model, geom, count, offset)
    turn = _matrix(model.geom_quat[geom])
    points = points @ turn.T + model.geom_pos[geom]
    normals = normals @ turn.T
    kept = np.ones(len(points), dtype=bool)
    for other in others:
        if other != geom and model.geom_bodyid[other] == model.geom_bodyid[geom]:
            local = (points - model.geom_pos[other]) @ _matrix(model.geom_quat[other])
            kept &= ~inside(model, other, local, _BURIED)
    return points[kept], normals[kept]


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, quaternion)
    return rotation.reshape(3, 3)

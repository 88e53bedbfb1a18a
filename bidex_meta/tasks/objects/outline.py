"""The outline of a body's colliding geoms as balls whose convex hull holds them: enough to lay it on a hand."""

import mujoco
import numpy as np

_AROUND = 12
"""Points around a cylinder's rim, which stand out by 3.5 % so that nothing of the rim does."""
_OVER = 128
"""Directions in which an ellipsoid's and a mesh's outermost points are taken."""


def outline(model: mujoco.MjModel, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Centres (k, 3) and radii (k,) of balls whose convex hull holds a body's geoms; body frame, metres.

    Of ellipsoids and meshes a hundredth of their size may stand out. Geoms that are only seen do not count; without
    others both are empty.
    """
    centres, radii = [np.zeros((0, 3))], [np.zeros(0)]
    for geom in np.flatnonzero(model.geom_bodyid == body):
        if model.geom_contype[geom] == 0 and model.geom_conaffinity[geom] == 0:
            continue
        points, radius = _own_frame(model, int(geom))
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
        centres.append(points @ turn.reshape(3, 3).T + model.geom_pos[geom])
        radii.append(np.full(len(points), radius))
    return np.concatenate(centres), np.concatenate(radii)


def extents(model: mujoco.MjModel, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of the box around what collides of a body, body frame, metres, each (3,).

    The outline's box and that of the geoms' own boxes both hold it; a cylinder stands out of neither in one of them.
    """
    centres, radii = outline(model, body)
    low, high = (centres - radii[:, None]).min(axis=0), (centres + radii[:, None]).max(axis=0)
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    turn, corners = np.zeros(9), []
    for geom in np.flatnonzero(model.geom_bodyid == body):
        if model.geom_contype[geom] or model.geom_conaffinity[geom]:
            mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
            box = model.geom_aabb[geom, :3] + signs * model.geom_aabb[geom, 3:]
            corners.append(box @ turn.reshape(3, 3).T + model.geom_pos[geom])
    found = np.concatenate(corners)
    return np.maximum(low, found.min(axis=0)), np.minimum(high, found.max(axis=0))


def _own_frame(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, float]:
    """Ball centres (k, 3) in the geom's frame, and their radius."""
    kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return np.zeros((1, 3)), size[0]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]]), size[0]
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return signs * size, 0.0
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        angle = 2 * np.pi * np.arange(_AROUND) / _AROUND
        radius = size[0] / np.cos(np.pi / _AROUND)
        rim = np.stack((radius * np.cos(angle), radius * np.sin(angle), np.full(_AROUND, size[1])), axis=1)
        return np.concatenate((rim, rim * (1, 1, -1))), 0.0
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return _directions() * size, 0.0
    first, count = model.mesh_vertadr[model.geom_dataid[geom]], model.mesh_vertnum[model.geom_dataid[geom]]
    vertices = model.mesh_vert[first : first + count].astype(np.float64)
    return vertices[np.unique((vertices @ _directions().T).argmax(axis=0))], 0.0


def _directions() -> np.ndarray:
    """Unit vectors spread evenly over the ball (a Fibonacci lattice), shape (k, 3)."""
    i = np.arange(_OVER) + 0.5
    z, angle = 1 - 2 * i / _OVER, np.pi * (1 + 5**0.5) * i
    ring = np.sqrt(1 - z**2)
    return np.stack((ring * np.cos(angle), ring * np.sin(angle), z), axis=1)

"""Geoms of a model as triangles, for viewers that know no primitives of MuJoCo's."""

from importlib import import_module

import mujoco
import numpy as np

from bidex_meta.errors import BidexError

_TYPE = mujoco.mjtGeom
_SHOWN_GROUPS = 3
"""Groups from here on are hidden, as in MuJoCo's own viewer."""


def visible(model: mujoco.MjModel) -> list[int]:
    """Geoms that a viewer shows; planes are left to it."""
    return [
        geom
        for geom in range(model.ngeom)
        if model.geom_group[geom] < _SHOWN_GROUPS
        and model.geom_type[geom] != _TYPE.mjGEOM_PLANE
        and colour(model, geom)[3] > 0.0
    ]


def colour(model: mujoco.MjModel, geom: int) -> tuple[float, float, float, float]:
    """Red, green, blue, alpha in [0, 1]: the geom's, or its material's."""
    material = int(model.geom_matid[geom])
    red, green, blue, alpha = (model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]).tolist()
    return red, green, blue, alpha


def shape(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3), metres, in the geom's frame, and triangles (m, 3) of a geom.

    Raises:
        BidexError: A height field or the like.
    """
    make = import_module("trimesh.creation")  # of viser's packages
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == _TYPE.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        points, faces = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
        return (
            model.mesh_vert[points : points + model.mesh_vertnum[mesh]].astype(float),
            model.mesh_face[faces : faces + model.mesh_facenum[mesh]].astype(int),
        )
    if kind == _TYPE.mjGEOM_SPHERE:
        made = make.icosphere(subdivisions=3, radius=size[0])
    elif kind == _TYPE.mjGEOM_ELLIPSOID:
        made = make.icosphere(subdivisions=3, radius=1.0)
        made.apply_scale(size)
    elif kind == _TYPE.mjGEOM_CAPSULE:
        made = make.capsule(height=2.0 * size[1], radius=size[0], count=(16, 16))
        made.apply_translation((0.0, 0.0, -made.bounds.mean(axis=0)[2]))  # from one end on in some versions
    elif kind == _TYPE.mjGEOM_CYLINDER:
        made = make.cylinder(radius=size[0], height=2.0 * size[1], sections=32)
    elif kind == _TYPE.mjGEOM_BOX:
        made = make.box(extents=2.0 * size)
    else:
        raise BidexError(
            f"Expected geoms that the browser can show (primitives, meshes), got {model.geom(geom).name!r} of type "
            f"{_TYPE(int(kind)).name}. Make a film of it: bidex-meta render."
        )
    return np.asarray(made.vertices), np.asarray(made.faces)

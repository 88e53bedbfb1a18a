"""Reading and checking of users' MJCF files with objects, and balls that enclose the objects' colliding geoms.

MuJoCo opens any file that a model names. Each file is therefore checked before MuJoCo reads it: it may contain listed
tags only, no entities and no includes, and may name no file outside its own folder.
"""

import math
import re
from itertools import product
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

import mujoco
import numpy as np

from bidex_meta.errors import BidexError, one_line, shortened
from bidex_meta.utils.files import is_file, read_bytes

_MOST_BYTES = 1_000_000
_MOST_MESH_BYTES = 20_000_000
_MOST_TAGS = 2_000
_DEEPEST = 32
_TAGS = {"mujoco", "compiler", "default", "asset", "material", "texture", "mesh", "worldbody"}
_TAGS |= {"body", "inertial", "geom", "joint", "freejoint", "site"}
"""Tags that a file may hold; a file that names points (``points=True``) may also hold sensors."""
_SENSOR_TAGS = {"sensor", "framepos", "framequat", "framelinvel", "frameangvel", "jointpos"}
_SOLREF, _SOLIMP, _MARGIN = (0.0084, 1.0), (0.95, 0.99, 0.001), 0.002
"""Contact parameters of the files under assets/objects, as stiff as the time step allows (bidex_meta/hands/README.md).
"""
_NOT_FINITE = re.compile(r"(?:^|\s)[+-]?(?:inf(?:inity)?|nan(?:\([^)]*\))?)(?:\s|$)", re.IGNORECASE)
"""Finds numbers that are not finite: MuJoCo accepts such numbers and writes a log file into the working folder."""
_MOST_FRICTION = 5.0
_SHAPES = ("sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")
"""Types of geoms whose outline is known."""


def read_own(path: Path, points: bool = False) -> mujoco.MjSpec:
    """Check and read an MJCF file with an object.

    The returned specification names meshes and textures by absolute paths. With ``points`` the file may contain
    sensors. Raises BidexError if the file cannot be read, is no MJCF, has a tag that no object needs, or names a file
    that is missing or outside its folder.
    """
    content = read_bytes(path, "an object's MJCF file", _MOST_BYTES)
    _check_tags(path, content, _TAGS | _SENSOR_TAGS if points else _TAGS)
    try:
        spec = mujoco.MjSpec.from_string(content.decode())
    except (ValueError, UnicodeDecodeError) as error:
        raise BidexError(f"{path}: expected an object in MJCF, but {_reason(error)}") from None
    for folder, parts in ((spec.meshdir, spec.meshes), (spec.texturedir, spec.textures)):
        for part in parts:
            if part.file:
                part.file = str(_beside(path, Path(folder) / part.file))
    spec.meshdir = spec.texturedir = ""
    return spec


def compiled(path: Path, spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Return the compiled model of a specification that was read from ``path``.

    Raises BidexError if MuJoCo cannot compile the specification, or if masses, inertias or sizes are not finite.
    """
    try:
        model = spec.copy().compile()
    except ValueError as error:
        raise BidexError(f"{path}: expected an object in MJCF, but {_reason(error)}") from None
    if not math.isfinite(float(model.body_mass.sum() + model.body_inertia.sum() + model.geom_size.sum())):
        raise BidexError(f"{path}: expected finite sizes and masses, got others. Fix the file.")
    return model


def set_contacts(spec: mujoco.MjSpec) -> None:
    """Set the contact softness and the contact margin of all geoms to the values that the world's time steps need.

    Friction stays as in the file.
    """
    for geom in spec.geoms:
        geom.solref[:2] = _SOLREF
        geom.solimp[:3] = _SOLIMP
        geom.margin = _MARGIN
        geom.gap = 0.0


def colliding(model: mujoco.MjModel) -> int:
    """Return the number of geoms that collide."""
    return int(((model.geom_contype != 0) | (model.geom_conaffinity != 0)).sum())


def check_collisions(path: Path, model: mujoco.MjModel, most: int) -> int:
    """Return the number of geoms that collide in the model of an MJCF file.

    Raises BidexError if this number is 0 or above ``most``, or if a geom has another shape than ``_SHAPES``, or
    friction out of bounds.
    """
    for kind in np.unique(model.geom_type):
        shape = mujoco.mjtGeom(int(kind)).name.removeprefix("mjGEOM_").lower()
        if shape not in _SHAPES:
            raise BidexError(f"{path}: expected geoms of type {', '.join(_SHAPES)}, got {shape}. Replace it.")
    geoms = colliding(model)
    if not 0 < geoms <= most:
        raise BidexError(f"{path}: expected at least one and at most {most} geoms that collide, got {geoms}. Fix it.")
    for friction in (model.geom_friction.min(), model.geom_friction[:, 0].max()):
        if not 0.0 <= friction <= _MOST_FRICTION:
            raise BidexError(f"{path}: expected friction of 0 to {_MOST_FRICTION:g}, got {friction:.4g}. Fix it.")
    return geoms


def check_pose(path: Path, model: mujoco.MjModel, body: int) -> None:
    """Raise BidexError if an object's outermost body has a pose: the class places the object and ignores the pose."""
    if model.body_pos[body].any() or not abs(model.body_quat[body, 0]) > 1.0 - 1e-9:
        raise BidexError(
            f"{path}: expected a <body> without pos and orientation, got one with them. Leave them out, or move and "
            "turn its geoms."
        )


def check_centres(path: Path, centres: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    """Raise BidexError unless the bodies' centres of mass (n, 3) lie in the box from ``low`` to ``high``."""
    if (centres < low).any() or (centres > high).any():
        raise BidexError(
            f"{path}: expected the centre of mass inside the shape, got it outside. Fix the pos of <inertial>, or the "
            "masses."
        )


def _reason(error: Exception) -> str:
    return f"MuJoCo says: {one_line(error)[:200].rstrip('.')}. Fix the file."


def _beside(path: Path, name: Path) -> Path:
    """Return the path of a file that an MJCF file names; it must lie in the folder of the MJCF file or below it."""
    folder = path.resolve().parent
    found = (folder / name).resolve()
    if not found.is_relative_to(folder):
        raise BidexError(
            f"{path}: expected files in its own folder, got {one_line(name)}. Put it next to the object's file."
        )
    if not is_file(found):
        raise BidexError(f"{path}: expected the file {one_line(name)} next to it, but there is none. Fix the path.")
    if found.stat().st_size > _MOST_MESH_BYTES:
        raise BidexError(f"{path}: expected {one_line(name)} with at most {_MOST_MESH_BYTES:,} bytes. Simplify it.")
    return found


def _check_tags(path: Path, content: bytes, allowed: set[str]) -> None:
    """Raise BidexError if an MJCF file has content that may do harm or that an object does not need.

    This check comes before MuJoCo reads the file. The file may contain ``allowed`` tags only, and not too many or too
    deeply nested. It must not contain a document type, because entities may expand without end. Numbers must be finite,
    and folders of assets must be relative paths.
    """

    def refuse(expected: str, received: str, mend: str) -> NoReturn:
        raise BidexError(f"{path}: expected {expected}, got {received}. {mend}")

    seen = 0
    depth = 0

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal seen, depth
        seen = seen + 1
        depth = depth + 1
        if seen > _MOST_TAGS or depth > _DEEPEST:
            refuse(f"at most {_MOST_TAGS:,} tags, {_DEEPEST} deep", "more", "Simplify the object.")
        if name == "include":
            refuse("an object in one file", "<include>", "Write its content into the file.")
        if name not in allowed:
            refuse("the tags of an object", f"<{one_line(name)[:60]}>", f"Known: {', '.join(sorted(allowed))}.")
        if name == "texture" and any(key.startswith("file") and key != "file" for key in attributes):
            refuse("a texture in one file", "one with a file for each side", "Leave it out.")
        for key, value in attributes.items():
            if _NOT_FINITE.search(value):
                refuse("finite numbers", f"{key}={shortened(one_line(value))}", "Fix the file.")
        for key in ("meshdir", "texturedir", "assetdir"):
            if Path(attributes.get(key, "")).is_absolute():
                refuse("a folder beside the file", f"{key} with an absolute path", "Write a relative one.")

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1

    parser = expat.ParserCreate()
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    received = "a document type, which may define entities"
    parser.StartDoctypeDeclHandler = lambda *_: refuse("plain MJCF", received, "Leave it out.")
    try:
        parser.Parse(content, True)
    except (expat.ExpatError, ValueError) as error:
        if isinstance(error, BidexError):
            raise
        raise BidexError(f"{path}: expected MJCF, but it is not XML: {one_line(error)}.") from None


_AROUND, _OVER = 12, 128
"""Number of points around a cylinder's rim, placed 3.5 % outside so that they enclose the rim; number of directions in
which the outermost points of an ellipsoid or a mesh are taken."""
_SIGNS = np.array(list(product((-1, 1), repeat=3)))


def _colliding(model: mujoco.MjModel, body: int) -> list[tuple[int, np.ndarray]]:
    """Return a body's geoms that collide, each with its rotation (3, 3) in the body's frame."""
    found = []
    for geom in np.flatnonzero(model.geom_bodyid == body):
        if model.geom_contype[geom] or model.geom_conaffinity[geom]:
            turn = np.zeros(9)
            mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
            found.append((int(geom), turn.reshape(3, 3)))
    return found


def outline(model: mujoco.MjModel, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Return balls whose convex hull holds all colliding geoms of a body: their centres (k, 3) and radii (k,).

    Both are in metres, in the body's frame. Ellipsoids and meshes may protrude by 1 % of their size. If no geom
    collides, both arrays are empty.
    """
    centres = [np.zeros((0, 3))]
    radii = [np.zeros(0)]
    for geom, turn in _colliding(model, body):
        points, radius = _own_frame(model, geom)
        centres.append(points @ turn.T + model.geom_pos[geom])
        radii.append(np.full(len(points), radius))
    return np.concatenate(centres), np.concatenate(radii)


def extents(model: mujoco.MjModel, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper corner, each (3,), of the box around a body's colliding geoms, body frame, metres.

    The result is the intersection of two boxes that both contain the geoms: the box around the outline, and the box
    around the bounding boxes of the geoms.
    """
    centres, radii = outline(model, body)
    low = (centres - radii[:, None]).min(axis=0)
    high = (centres + radii[:, None]).max(axis=0)
    boxes = model.geom_aabb
    own = _colliding(model, body)
    ends = [(boxes[geom, :3] + _SIGNS * boxes[geom, 3:]) @ turn.T + model.geom_pos[geom] for geom, turn in own]
    corners = np.concatenate(ends)
    return np.maximum(low, corners.min(axis=0)), np.minimum(high, corners.max(axis=0))


def _own_frame(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, float]:
    """Return balls whose convex hull holds one geom: their centres (k, 3) in the geom's frame, and their common radius.

    Lengths are in metres. An ellipsoid or a mesh may protrude by 1 % of its size.
    """
    kind = mujoco.mjtGeom(model.geom_type[geom])
    size = model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return np.zeros((1, 3)), size[0]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]]), size[0]
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return _SIGNS * size, 0.0
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        angle = 2 * np.pi * np.arange(_AROUND) / _AROUND
        radius = size[0] / np.cos(np.pi / _AROUND)
        rim = np.stack((radius * np.cos(angle), radius * np.sin(angle), np.full(_AROUND, size[1])), axis=1)
        return np.concatenate((rim, rim * (1, 1, -1))), 0.0
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return _directions() * size, 0.0
    first = model.mesh_vertadr[model.geom_dataid[geom]]
    count = model.mesh_vertnum[model.geom_dataid[geom]]
    vertices = model.mesh_vert[first : first + count].astype(np.float64)
    return vertices[np.unique((vertices @ _directions().T).argmax(axis=0))], 0.0


def _directions() -> np.ndarray:
    """Return unit vectors spread evenly over the sphere (a Fibonacci lattice), shape (k, 3)."""
    i = np.arange(_OVER) + 0.5
    z = 1 - 2 * i / _OVER
    angle = np.pi * (1 + 5**0.5) * i
    ring = np.sqrt(1 - z**2)
    return np.stack((ring * np.cos(angle), ring * np.sin(angle), z), axis=1)

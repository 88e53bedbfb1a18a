"""A user's own MJCF file, checked before MuJoCo reads it: no entities, no includes, no file from elsewhere.

MuJoCo opens whatever a model names, so that what a file may hold is listed here rather than what it may not.
"""

import math
import re
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

import mujoco

from bidex_meta.errors import BidexError, one_line, shortened
from bidex_meta.reading import is_file, read_bytes

_MOST_BYTES, _MOST_MESH_BYTES = 1_000_000, 20_000_000
_MOST_TAGS = 2_000
_DEEPEST = 32
_OUTER_TAGS = frozenset(("mujoco", "compiler", "default", "asset", "material", "texture", "mesh", "worldbody"))
_TAGS = _OUTER_TAGS | {"body", "inertial", "geom", "joint", "freejoint", "site"}
"""What a file may hold; sensors may stand in a file that names points (``points=True``)."""
_SENSOR_TAGS = frozenset(["sensor", "framepos", "framequat", "framelinvel", "frameangvel", "jointpos"])
_SOLREF, _SOLIMP, _MARGIN = (0.0084, 1.0), (0.95, 0.99, 0.001), 0.002
"""As those of the files under assets/objects: as stiff as the time step allows (bidex_meta/hands/README.md)."""
_NOT_FINITE = re.compile(r"(?:^|\s)[+-]?(?:inf(?:inity)?|nan(?:\([^)]*\))?)(?:\s|$)", re.IGNORECASE)
"""MuJoCo takes such numbers, and writes a log file into the working folder."""
_FOLDERS = ("meshdir", "texturedir", "assetdir")


def read_own(path: Path, points: bool = False) -> mujoco.MjSpec:
    """The specification that an MJCF file holds, files that it names with absolute paths.

    Args:
        path: The file.
        points: Whether it may have sensors.

    Raises:
        BidexError: It cannot be read, is no MJCF, holds what no object needs, or names a file that is missing or lies
            outside its folder.
    """
    content = read_bytes(path, "an object's MJCF file", _MOST_BYTES)
    _check_tags(path, content, _TAGS | _SENSOR_TAGS if points else _TAGS)
    try:
        spec = mujoco.MjSpec.from_string(content.decode())
    except (ValueError, UnicodeDecodeError) as error:
        raise BidexError(f"{path}: expected an object in MJCF, but {_reason(error)}") from None
    folders = {name: getattr(spec, name, "") or "" for name in ("meshdir", "texturedir")}
    for mesh in spec.meshes:
        if mesh.file:
            mesh.file = str(_beside(path, Path(folders["meshdir"]) / mesh.file))
    for texture in spec.textures:
        if texture.file:
            texture.file = str(_beside(path, Path(folders["texturedir"]) / texture.file))
    spec.meshdir = spec.texturedir = ""
    return spec


def compiled(path: Path, spec: mujoco.MjSpec) -> mujoco.MjModel:
    """The model of a specification.

    Raises:
        BidexError: MuJoCo refuses it (a size below zero, a mesh that is none, ...), or its numbers are not finite.
    """
    try:
        model = spec.copy().compile()
    except ValueError as error:
        raise BidexError(f"{path}: expected an object in MJCF, but {_reason(error)}") from None
    if not math.isfinite(float(model.body_mass.sum() + model.body_inertia.sum() + model.geom_size.sum())):
        raise BidexError(f"{path}: expected finite sizes and masses, got others. Mend the file.")
    return model


def set_contacts(spec: mujoco.MjSpec) -> None:
    """Gives geoms the softness and the margin that the world's time steps need; friction stays the file's."""
    for geom in spec.geoms:
        geom.solref[:2], geom.solimp[:3] = _SOLREF, _SOLIMP
        geom.margin, geom.gap = _MARGIN, 0.0


def _reason(error: Exception) -> str:
    return f"MuJoCo says: {one_line(error)[:200].rstrip('.')}. Mend the file."


def _beside(path: Path, name: Path) -> Path:
    """The file of that name in the folder of an MJCF file, or below it."""
    folder = path.resolve().parent
    found = (folder / name).resolve()
    if not found.is_relative_to(folder):
        raise BidexError(f"{path}: expected files in its own folder, got {one_line(name)}. Put it beside the object.")
    if not is_file(found):
        raise BidexError(f"{path}: expected the file {one_line(name)} beside it, but there is none. Mend the path.")
    if found.stat().st_size > _MOST_MESH_BYTES:
        raise BidexError(f"{path}: expected {one_line(name)} with at most {_MOST_MESH_BYTES:,} bytes. Simplify it.")
    return found


def _check_tags(path: Path, content: bytes, allowed: frozenset[str]) -> None:
    """Refuses entities, which may expand without end, and every tag that is not allowed."""

    def refuse(expected: str, received: str, mend: str) -> NoReturn:
        raise BidexError(f"{path}: expected {expected}, got {received}. {mend}")

    seen, depth = 0, 0

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal seen, depth
        seen, depth = seen + 1, depth + 1
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
                refuse("finite numbers", f"{key}={shortened(one_line(value))}", "Mend the file.")
        for key in _FOLDERS:
            if Path(attributes.get(key, "")).is_absolute():
                refuse("a folder beside the file", f"{key} with an absolute path", "Write a relative one.")

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1

    def doctype(*_: object) -> None:
        refuse("plain MJCF", "a document type, which may define entities", "Leave it out.")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(content, True)
    except (expat.ExpatError, ValueError) as error:
        if isinstance(error, BidexError):
            raise
        raise BidexError(f"{path}: expected MJCF, but it is no XML: {one_line(error)}.") from None

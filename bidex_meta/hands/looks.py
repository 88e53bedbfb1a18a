"""Meshes of a hand for pictures: tapered links, palm and forearm, lofted here. Physics does not use them."""

from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise

import mujoco
import numpy as np

from bidex_meta.hands.hand import FINGERS, SIDES

Section = tuple[float, float, float, float, float]
"""A cross-section: z, centre x and y, half-widths along x and y, millimetres, in the frame of a body."""
_AROUND, _ALONG, _DOME = 20, 4, 4
"""Numbers of corners of a ring, of rings from one section to the next, and of rings of a rounded end."""
_HIDDEN_GROUP = 3
"""Viewers leave out geoms of this group."""
_OF_HANDS = tuple(f"{side}/" for side in SIDES)
_Mesh = tuple[np.ndarray, np.ndarray]
"""Points (n, 3), metres, and triangles (m, 3)."""


def loft(sections: Sequence[Section], low: float, high: float, power: float = 2.0) -> _Mesh:
    """Return a closed mesh that passes through cross-sections, which are in ascending order of z.

    Rounded ends add ``low`` mm below the first section and ``high`` mm above the last one. ``power`` sets the shape of
    a section: 2 gives an ellipse, and larger values give a rounded rectangle.
    """
    given = np.array(sections)
    z = np.concatenate([np.linspace(a, b, _ALONG, endpoint=False) for a, b in pairwise(given)])
    rings = _smooth(given, np.append(z[:, 0], given[-1, 0]))
    angle = np.linspace(0.0, 0.5 * np.pi, _DOME + 1)[1:]
    ends = []
    for ring, depth in ((rings[0], -low), (rings[-1], high)):
        dome = np.repeat(ring[None], _DOME, axis=0)
        dome[:, 0] += depth * np.sin(angle)
        dome[:, 3:] *= np.maximum(np.cos(angle), 1e-3)[:, None]
        ends.append(dome)
    rings = np.concatenate((ends[0][::-1], rings, ends[1]))
    turn = np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)
    across = np.stack((np.cos(turn), np.sin(turn)), axis=1)
    across = np.sign(across) * np.abs(across) ** (2.0 / power)
    points = np.empty((len(rings), _AROUND, 3))
    points[..., :2] = rings[:, None, 1:3] + rings[:, None, 3:] * across
    points[..., 2] = rings[:, :1]
    return 0.001 * points.reshape(-1, 3), _triangles(len(rings))


def _smooth(given: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Interpolate sections at heights ``z`` by cubics without overshoot (Fritsch and Carlson 1980)."""
    step = np.diff(given[:, 0])[:, None]
    slope = np.diff(given[:, 1:], axis=0) / step
    inner = np.where(slope[1:] * slope[:-1] > 0.0, 2.0 * slope[1:] * slope[:-1], 0.0)
    inner /= np.where(inner > 0.0, slope[1:] + slope[:-1], 1.0)
    tangent = np.concatenate((slope[:1], inner, slope[-1:]))
    i = np.clip(np.searchsorted(given[:, 0], z, side="right") - 1, 0, len(step) - 1)
    t = (z - given[i, 0])[:, None] / step[i]
    value = given[i, 1:] * (1 + 2 * t) * (1 - t) ** 2 + given[i + 1, 1:] * t * t * (3 - 2 * t)
    value += step[i] * (tangent[i] * t * (1 - t) ** 2 + tangent[i + 1] * t * t * (t - 1))
    return np.column_stack((z, value))


def _triangles(rings: int) -> np.ndarray:
    """Return the triangles between neighbouring rings, and across the first and the last ring."""
    first = np.arange(_AROUND)
    a = first
    b = (first + 1) % _AROUND
    strip = np.stack((a, b, b + _AROUND, a, b + _AROUND, a + _AROUND), axis=1).reshape(-1, 3)
    sides = [strip + _AROUND * ring for ring in range(rings - 1)]
    fan = np.stack((np.zeros(_AROUND - 2, int), first[1:-1], first[2:]), axis=1)
    return np.concatenate((*sides, fan[:, ::-1], fan + _AROUND * (rings - 1)))


@lru_cache(maxsize=1)
def _meshes() -> dict[str, _Mesh]:
    """Return the meshes of a hand's visual parts by name. The palm faces -y, and the thumb is at +x."""
    return {
        "proximal": loft([(5, 0, 0, 8.6, 8.8), (20, 0, 0, 7.9, 8.6), (37, 0, 0, 7.2, 7.4)], 3, 3, 2.6),
        "middle": loft([(5, 0, 0, 7.2, 7.4), (13, 0, 0, 6.7, 7.2), (19, 0, 0, 6.5, 6.6)], 2.5, 2.5, 2.6),
        "distal": loft([(4, 0, 0, 6.5, 6.4), (14, 0, -0.3, 7.2, 6.7), (22, 0, -0.4, 6.0, 5.6)], 2, 9, 2.2),
        "thproximal": loft([(4, 0, 0, 11.5, 12), (18, 0, 0, 10.6, 11.4), (30, 0, 0, 9.4, 9.8)], 5, 3, 2.6),
        "thmiddle": loft([(6, 0, 0, 9.4, 9.6), (16, 0, 0, 8.8, 9.2), (25, 0, 0, 8.4, 8.4)], 3, 3, 2.6),
        "thdistal": loft([(5, 0, 0, 8.3, 8.2), (15, -0.3, 0, 8.8, 9.0), (25, -0.4, 0, 7.2, 7.6)], 2.5, 10, 2.2),
        "palm": loft(
            [(-6, 2, 1, 25, 12), (10, 1, 0, 38, 13), (32, 3, 0, 39, 12.5), (43, 8, 0, 34, 12), (84, 11, 0, 32, 10)],
            6, 5, 4.5,
        ),
        "thenar": loft([(2, 24, -8, 11, 7), (22, 27, -9, 16, 10), (44, 24, -8, 12, 6)], 8, 10),
        "back": loft([(4, 1, 10, 25, 5), (40, 6, 10, 27, 5), (78, 11, 9, 25, 4)], 4, 4, 5),
        "metacarpal": loft([(-10, -15, 0, 10, 11), (20, -16, 0, 10.5, 10.5), (34, -17, 0, 9.5, 9)], 5, 4, 3.5),
        "wrist": loft([(-16, 0, 4, 30, 24), (4, 0, 1, 24, 17), (22, 1, 0, 23, 14)], 6, 5, 2.8),
        "forearm": loft(
            [(46, 0, 10, 55, 55), (70, 0, 10, 60, 60), (150, 0, 10, 59, 58), (200, 0, 10, 50, 47), (236, 0, 7, 37, 31)],
            8, 7, 2.4,
        ),
        "ring": loft([(114, 0, 10, 60.9, 60.7), (124, 0, 10, 60.6, 60.2)], 1, 1, 2.4),
        "cover": loft([(74, 0, 38, 34, 27), (120, 0, 38, 35, 27), (178, 0, 33, 27, 22)], 10, 10, 3.5),
    }  # fmt: skip


_PINS = {"proximal": (9.2, 8.6), "middle": (7.8, 8.0), "distal": (6.8, 7.2)}
_THUMB_PINS = {"thproximal": (12.4, 11.0), "thmiddle": (10.4, 9.6), "thdistal": (9.0, 8.6)}
"""Radius and half length of the pin on which a link turns, millimetres."""


def dress(scene: mujoco.MjSpec) -> None:
    """Add visual meshes to both hands of a scene, and hide their colliding geoms; bodies and joints do not change."""
    for geom in scene.geoms:
        if geom.name.startswith(_OF_HANDS):
            geom.group = _HIDDEN_GROUP
    for name, (points, faces) in _meshes().items():
        scene.add_mesh(name=f"looks/{name}", uservert=points.ravel(), userface=faces.ravel().astype(np.int32))
    for side in SIDES:
        _Tailor(scene, side).dress()


class _Tailor:
    """Attaches skins to one hand's bodies."""

    def __init__(self, scene: mujoco.MjSpec, side: str) -> None:
        self._scene = scene
        self._side = side

    def _add(self, body: str, material: str, **shape: object) -> None:
        # Skins add no mass and no contacts, because bodies define their own inertia.
        self._scene.body(f"{self._side}/{body}").add_geom(
            material=f"{self._side}/{material}", contype=0, conaffinity=0, mass=0, group=0, **shape
        )

    def _skin(self, body: str, mesh: str, material: str) -> None:
        self._add(body, material, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"looks/{mesh}")

    def _pin(self, body: str, radius: float, half: float, axis: tuple[float, float, float], z: float = 0.0) -> None:
        ends: list[float] = []
        for sign in (-1, 1):
            end = (sign * half * axis[0], sign * half * axis[1], z + sign * half * axis[2])
            ends += [*(0.001 * np.array(end))]
        self._add(body, "link", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.001 * radius, 0, 0], fromto=ends)

    def dress(self) -> None:
        self._skin("forearm", "forearm", "forearm")
        self._skin("forearm", "cover", "link")
        self._skin("forearm", "ring", "tip")
        self._skin("wrist", "wrist", "link")
        for mesh, material in (("palm", "forearm"), ("thenar", "link"), ("back", "shell")):
            self._skin("palm", mesh, material)
        self._skin("lfmetacarpal", "metacarpal", "forearm")
        for finger in FINGERS[:4]:
            self._pin(f"{finger}knuckle", 8.4, 8.8, (0, 1, 0))
            for link, (radius, half) in _PINS.items():
                self._skin(f"{finger}{link}", link, "tip" if link == "distal" else "shell")
                self._pin(f"{finger}{link}", radius, half, (1, 0, 0))
        for link, (radius, half) in _THUMB_PINS.items():
            self._skin(link, link, "tip" if link == "thdistal" else "shell")
            self._pin(link, radius, half, (1, 0, 0) if link == "thproximal" else (0, 1, 0))

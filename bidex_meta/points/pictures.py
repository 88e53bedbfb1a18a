"""Pictures of a cloud: dots coloured by kind, the nearer the larger and the lighter."""

import numpy as np

from bidex_meta.points.cloud import Camera
from bidex_meta.points.surfaces import FIXTURE, HAND, OBJECT

_BACK = (24, 26, 30)
_COLOURS = {FIXTURE: (120, 126, 138), HAND: (92, 160, 235), OBJECT: (245, 150, 60)}
_DOT = 0.0035
"""Radius of a dot, metres."""


def beside(camera: Camera) -> Camera:
    """A camera at the same distance from the same target, from the side."""
    far = float(np.linalg.norm(np.subtract(camera.eye, camera.target)))
    x, y, z = camera.target
    return Camera((x, y - 0.94 * far, z + 0.34 * far), camera.target, camera.field_of_view)


def draw(cloud: np.ndarray, camera: Camera, width: int, height: int) -> np.ndarray:
    """A picture (height, width, 3), uint8, of a cloud.

    Args:
        cloud: Points (n, 4): world, metres, and their kinds (``surfaces.FIXTURE``, ...).
        camera: Its field of view fits the smaller side of the picture.
        width: Pixels.
        height: Pixels.
    """
    picture = np.empty((height, width, 3), np.uint8)
    picture[:] = _BACK
    seen = (cloud[:, :3] - camera.eye) @ camera.axes.T
    kept = (seen[:, 2] > camera.near) & np.isfinite(seen).all(axis=1)
    seen, kinds = seen[kept], cloud[kept, 3]
    if not len(seen):
        return picture
    scale = camera.focal * min(width, height) / seen[:, 2]
    columns, rows = seen[:, 0] * scale + 0.5 * width, seen[:, 1] * scale + 0.5 * height
    near, far = seen[:, 2].min(), seen[:, 2].max()
    light = 1.0 - 0.55 * (seen[:, 2] - near) / max(far - near, 1e-6)
    down, across = np.mgrid[:height, :width]
    for i in np.argsort(-seen[:, 2]):
        size = max(_DOT * scale[i], 0.8)
        top, left = max(int(rows[i] - size), 0), max(int(columns[i] - size), 0)
        part = (slice(top, int(rows[i] + size) + 2), slice(left, int(columns[i] + size) + 2))
        dot = (down[part] - rows[i]) ** 2 + (across[part] - columns[i]) ** 2 <= size * size
        picture[part][dot] = (light[i] * np.array(_COLOURS[float(kinds[i])])).astype(np.uint8)
    return picture

"""A depth camera, point clouds of what it sees, and pictures of clouds: torch operations on all environments."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bidex_meta.tasks.base import TaskClass
from bidex_meta.world.surfaces import FIXTURE, HAND, OBJECT, Surfaces

_DIRECTION = (0.49, 0.0, 0.75)
"""Direction from the target to the camera, taken from HandOver in the original code."""
FIELD_OF_VIEW = 60.0


@dataclass(frozen=True)
class Camera:
    """An upright pinhole camera with a square image; positions in the world frame, metres.

    Attributes:
        eye: Position of the camera.
        target: Point that appears in the middle of the image.
        field_of_view: Full angle of the image, degrees.
        near: Smallest distance that the camera sees; ``far``: largest distance.
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    field_of_view: float = FIELD_OF_VIEW
    near: float = 0.05
    far: float = 10.0

    @property
    def axes(self) -> np.ndarray:
        """Unit vectors to the right, down and forward in the image, as rows, (3, 3)."""
        forward = np.subtract(self.target, self.eye)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        if np.linalg.norm(right) < 1e-6:
            right = np.array((1.0, 0.0, 0.0))  # the camera looks straight up or down
        right /= np.linalg.norm(right)
        return np.stack((right, np.cross(forward, right), forward))

    @property
    def focal(self) -> float:
        """Focal length as a multiple of the image's width."""
        return float(0.5 / np.tan(np.radians(0.5 * self.field_of_view)))


def camera_of(task: TaskClass) -> Camera:
    """Return the depth camera of a class: ``depth_camera``, or by default one that looks down at ``camera_target``."""
    if task.depth_camera is not None:
        return Camera(*task.depth_camera)
    away = np.array(_DIRECTION) / np.linalg.norm(_DIRECTION)
    x, y, z = np.array(task.camera_target) + task.camera_distance * 0.8 * away
    return Camera((float(x), float(y), float(z)), task.camera_target)


_CHUNK = 32
"""Number of environments that a CPU computes at once, chosen so that their data fits into its cache."""


_PIXELS = 128
"""Edge of the square depth buffer in which visibility is tested."""
_DEPTH = 0.004
_SLOPE = 1.5
_MOST_SLOPE = 0.05
"""A visible point may lie up to ``_DEPTH`` (m) behind the nearest point around its pixel. On slanted surfaces it may
lie further behind, by ``_SLOPE`` times the change of depth across a pixel, but at most by ``_MOST_SLOPE`` (m)."""


class Cloud:
    """Computes the point clouds of environments that share one model.

    The candidates are the points of ``surfaces``. A candidate is visible if it faces the camera, lies in the camera's
    frustum, and nothing nearer was drawn around its pixel in a coarse depth buffer. Shapes of tensors do not depend
    on values, so that CUDA graphs can record the computation.

    A cloud has ``count`` points. With ``kinds`` each point has a fourth entry, its kind (``surfaces.FIXTURE``, ...).
    """

    def __init__(
        self,
        surfaces: Surfaces,
        camera: Camera,
        count: int,
        kinds: bool = False,
        device: str | torch.device = "cpu",
    ) -> None:
        def tensor(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=device).contiguous()

        self.shape = (count, 4 if kinds else 3)
        self.camera = camera
        self._bodies = torch.as_tensor(surfaces.bodies, device=device).long()
        points = surfaces.points.T
        normals = surfaces.normals.T
        ones = np.ones_like(points[:1])
        starts = [0, *surfaces.ends[:-1]]
        self._parts = [slice(int(a), int(b)) for a, b in zip(starts, surfaces.ends, strict=True)]
        self._places = [tensor(np.concatenate((points, ones))[:, part]) for part in self._parts]
        along = (points * normals).sum(axis=0, keepdims=True)
        self._faces = [tensor(np.concatenate((normals, -along))[:, part]) for part in self._parts]
        self._axes = tensor(camera.axes)
        self._eye = tensor(np.array(camera.eye))
        if kinds:
            self._kinds = tensor(surfaces.kinds)
        else:
            self._kinds = None
        self._slots = torch.arange(count, device=device)
        self._size = len(surfaces.points)

    def __call__(self, position: Tensor, rotation: Tensor) -> Tensor:
        """Return the clouds of n environments in the world frame, in metres: (n, count, 3 or 4), float32.

        If there are fewer visible candidates than points, candidates are repeated; if there are more, an evenly spread
        subset is taken. Hidden candidates do not affect the result. If nothing is visible, the cloud is all zeros.
        ``position`` (n, nbody, 3), in metres, and ``rotation`` (n, nbody, 3, 3) are those of the model's bodies.
        """
        if position.device.type == "cpu" and len(position) > _CHUNK:
            pairs = zip(position.split(_CHUNK), rotation.split(_CHUNK), strict=True)
            return torch.cat([self._clouds(*pair) for pair in pairs])
        return self._clouds(position, rotation)

    def _clouds(self, position: Tensor, rotation: Tensor) -> Tensor:
        x, y, depth, facing = self._in_camera(position, rotation)
        seen = self._seen(x, y, depth, facing)
        number = seen.cumsum(1, dtype=torch.int32)
        total = number[:, -1:].long()
        wanted = (self._slots * total.clamp(min=1)) // len(self._slots) + 1
        index = torch.searchsorted(number, wanted.int()).clamp_(max=self._size - 1)
        chosen = torch.stack([plane.gather(1, index) for plane in (x, y, depth)], dim=2)
        cloud = chosen @ self._axes + self._eye
        if self._kinds is not None:
            cloud = torch.cat((cloud, self._kinds[index][..., None]), dim=2)
        # torch.where is used instead of a product, because candidates are NaN if physics broke.
        return torch.where(total[..., None] > 0, cloud, 0.0)

    def _in_camera(self, position: Tensor, rotation: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the candidates' positions relative to the camera, and the camera's distances from their surfaces.

        Candidates are the points that the camera may see. Returns four tensors (n, P), in metres. The first three are
        the position relative to the camera: to the right, down and forward. The fourth is the distance from the camera
        to the candidate's tangent plane; it is positive if the surface faces the camera.
        """
        turn = rotation.index_select(1, self._bodies).float()
        offset = position.index_select(1, self._bodies).float() - self._eye
        poses = torch.cat((self._axes @ turn, (offset @ self._axes.T)[..., None]), dim=3)
        # The eye is in the body's frame; n . (eye - p) is positive if a surface faces the eye.
        eye = torch.cat((-(offset[:, :, None] @ turn)[:, :, 0], torch.ones_like(offset[..., :1])), dim=2)
        n = len(offset)
        places = offset.new_empty(n, 3, self._size)
        facing = offset.new_empty(n, self._size)
        for i, part in enumerate(self._parts):
            places[:, :, part] = poses[:, i] @ self._places[i]
            facing[:, part] = eye[:, i] @ self._faces[i]
        return places[:, 0], places[:, 1], places[:, 2], facing

    def _seen(self, x: Tensor, y: Tensor, depth: Tensor, facing: Tensor) -> Tensor:
        camera = self.camera
        focal = camera.focal * _PIXELS
        scale = focal / depth
        column = x * scale + 0.5 * _PIXELS
        row = y * scale + 0.5 * _PIXELS
        # The comparison is false for NaN, which broken physics gives.
        inside = (column >= 0) & (column < _PIXELS) & (row >= 0) & (row < _PIXELS)
        candidate = inside & (depth > camera.near) & (depth < camera.far) & (facing > 0)
        pixel = torch.where(candidate, row.floor() * _PIXELS + column.floor(), 0.0).long()
        # A neighbour on the same slanted surface must not hide a point. So each point draws the depth that its surface
        # has one pixel further away. From pixel to pixel, the depth changes by tan(angle) / focal times its value, with
        # cos(angle) = facing / distance.
        cosine = (facing / torch.sqrt(x * x + y * y + depth * depth)).clamp_min(1e-3)
        slant = torch.sqrt((1.0 - cosine * cosine).clamp_min(0.0)) / cosine
        reach = (_SLOPE * slant * depth / focal).clamp_max(_MOST_SLOPE)
        drawn = torch.where(candidate, depth + reach, torch.inf)
        buffer = torch.full((len(depth), _PIXELS**2), torch.inf, device=depth.device)
        buffer.scatter_reduce_(1, pixel, drawn, "amin")
        nearest = _spread(buffer.view(-1, _PIXELS, _PIXELS)).flatten(1).gather(1, pixel)
        return candidate & (depth <= nearest + _DEPTH)


def _spread(buffer: Tensor) -> Tensor:
    """Return the minimum over each pixel and its eight neighbours."""
    wide = buffer.clone()
    torch.minimum(wide[:, :, 1:], buffer[:, :, :-1], out=wide[:, :, 1:])
    torch.minimum(wide[:, :, :-1], buffer[:, :, 1:], out=wide[:, :, :-1])
    tall = wide.clone()
    torch.minimum(tall[:, 1:], wide[:, :-1], out=tall[:, 1:])
    torch.minimum(tall[:, :-1], wide[:, 1:], out=tall[:, :-1])
    return tall


_BACK = (24, 26, 30)
_COLOURS = {FIXTURE: (120, 126, 138), HAND: (92, 160, 235), OBJECT: (245, 150, 60)}
_DOT = 0.0035
"""Radius of a dot, metres."""


def beside(camera: Camera) -> Camera:
    """Return a camera that looks at the same target from the side, at the same distance."""
    far = float(np.linalg.norm(np.subtract(camera.eye, camera.target)))
    x, y, z = camera.target
    return Camera((x, y - 0.94 * far, z + 0.34 * far), camera.target, camera.field_of_view)


def draw(cloud: np.ndarray, camera: Camera, width: int, height: int) -> np.ndarray:
    """Draw a cloud (n, 4), and return the picture (height, width, 3), uint8.

    The cloud's rows hold a position (world frame, metres) and a kind (``surfaces.FIXTURE``, ...). The camera's field of
    view fits the smaller side of the picture.
    """
    picture = np.full((height, width, 3), _BACK, np.uint8)
    seen = (cloud[:, :3] - camera.eye) @ camera.axes.T
    kept = (seen[:, 2] > camera.near) & np.isfinite(seen).all(axis=1)
    seen = seen[kept]
    kinds = cloud[kept, 3]
    if not len(seen):
        return picture
    scale = camera.focal * min(width, height) / seen[:, 2]
    columns = seen[:, 0] * scale + 0.5 * width
    rows = seen[:, 1] * scale + 0.5 * height
    near = seen[:, 2].min()
    far = seen[:, 2].max()
    light = 1.0 - 0.55 * (seen[:, 2] - near) / max(far - near, 1e-6)
    down, across = np.mgrid[:height, :width]
    for i in np.argsort(-seen[:, 2]):
        size = max(_DOT * scale[i], 0.8)
        top = max(int(rows[i] - size), 0)
        left = max(int(columns[i] - size), 0)
        part = (slice(top, int(rows[i] + size) + 2), slice(left, int(columns[i] + size) + 2))
        dot = (down[part] - rows[i]) ** 2 + (across[part] - columns[i]) ** 2 <= size * size
        picture[part][dot] = (light[i] * np.array(_COLOURS[float(kinds[i])])).astype(np.uint8)
    return picture

"""The depth camera of a class: where it stands and what it looks at."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from bidex_meta.tasks.base import TaskClass

_DIRECTION = (0.49, 0.0, 0.75)
"""From the target to the camera, of HandOver in the original code."""
FIELD_OF_VIEW = 60.0


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with a square image, upright.

    Attributes:
        eye: Where it stands, in the row's frame (the world of the scene), metres.
        target: What is in the middle of its image, likewise.
        field_of_view: Full angle of the image, degrees.
        near: What is nearer than this is cut, metres.
        far: What is farther than this is cut, metres.
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
        right /= np.linalg.norm(right)
        return np.stack((right, np.cross(forward, right), forward))

    @property
    def focal(self) -> float:
        """Focal length in widths of the image."""
        return float(0.5 / np.tan(np.radians(0.5 * self.field_of_view)))


def camera_of(task: "TaskClass") -> Camera:
    """The depth camera of a class: its own, or one that looks down at what its pictures show, as HandOver's does."""
    if task.depth_camera is not None:
        return Camera(*task.depth_camera)
    away = np.array(_DIRECTION) / np.linalg.norm(_DIRECTION)
    x, y, z = np.array(task.camera_target) + task.camera_distance * 0.8 * away
    return Camera((float(x), float(y), float(z)), task.camera_target)

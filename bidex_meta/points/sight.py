"""What rows of a world see in the place of their objects' state."""

from dataclasses import dataclass

import torch
from torch import Tensor

from bidex_meta.errors import BidexError, shortened
from bidex_meta.points.camera import camera_of
from bidex_meta.points.cloud import Cloud
from bidex_meta.points.surfaces import sample
from bidex_meta.points.told import entries_of_objects
from bidex_meta.suite import MOST_POINTS
from bidex_meta.tasks.scene import Scene
from bidex_meta.validation import whole_number

CANDIDATES = 3072
"""Points fixed on a scene at least: fewer leave gaps through which what is hidden shines."""
POINT_ENTRIES = {"points": 3, "kind_points": 4}
"""Entries of a point, by the name of the clouds' observation group."""


@dataclass(frozen=True)
class PointsRule:
    """That observations show a point cloud, and of objects nothing else.

    Attributes:
        count: Points of a cloud; the original code takes 768.
        kinds: Whether each has a fourth entry: 1 of an object, 0 of a hand, -1 of what stands fast.
    """

    count: int = 768
    kinds: bool = False

    def __post_init__(self) -> None:
        """Refuses what is no number of points."""
        object.__setattr__(self, "count", whole_number("points", self.count, 1, MOST_POINTS))
        if not isinstance(self.kinds, bool):
            raise BidexError(f"Expected kinds of points as true or false, got {shortened(self.kinds)}.")

    @property
    def entries(self) -> int:
        """Entries of an observation that a cloud takes, point after point."""
        return self.count * POINT_ENTRIES[self.group]

    @property
    def group(self) -> str:
        """Name of their observation group: ``points``, or ``kind_points`` where a point has four entries."""
        return "kind_points" if self.kinds else "points"


class Sight:
    """The clouds of a class's rows.

    Args:
        scene: The class's scene.
        rule: What is seen.
        first: Where in an observation the cloud begins.
        device: Where to compute.

    Attributes:
        hidden: Entries of the class's observation that tell of objects' states, ascending.
    """

    def __init__(self, scene: Scene, rule: PointsRule, first: int, device: torch.device) -> None:
        surfaces = sample(scene.model, max(CANDIDATES, 2 * rule.count))
        self._cloud = Cloud(surfaces, camera_of(scene.task), rule.count, rule.kinds, device)
        self._columns = slice(first, first + rule.entries)
        self.hidden = entries_of_objects(scene)
        self._hidden = torch.tensor(self.hidden, dtype=torch.int64, device=device)

    def show(self, values: Tensor, position: Tensor, rotation: Tensor) -> None:
        """Turns observations of rows (n, d) into what the camera shows, in place.

        Args:
            values: The observations.
            position: Of the rows' bodies, metres, (n, nbody, 3).
            rotation: Likewise, matrices (n, nbody, 3, 3).
        """
        values.index_fill_(1, self._hidden, 0.0)
        values[:, self._columns] = self._cloud(position, rotation).flatten(1)

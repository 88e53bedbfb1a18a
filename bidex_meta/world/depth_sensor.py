"""The depth sensor: point clouds in place of the objects' state in observations."""

from dataclasses import dataclass

import mujoco
import torch
from torch import Tensor

from bidex_meta.hands.hand import SIDES
from bidex_meta.suite import MOST_POINTS
from bidex_meta.tasks.scene import Scene
from bidex_meta.tasks.state import TaskState
from bidex_meta.utils.validation import true_or_false, whole_number
from bidex_meta.world.cloud import Cloud, camera_of
from bidex_meta.world.surfaces import sample

CANDIDATES = 3072
"""Minimum number of points fixed to a scene's surfaces; fewer would leave gaps through which hidden points are seen."""
POINT_ENTRIES = {"points": 3, "kind_points": 4}
"""Number of observation entries per point, by the name of the cloud's observation group."""


@dataclass(frozen=True)
class PointsRule:
    """Observations with a cloud of ``count`` points (768 in Bi-DexHands) in place of the objects' state.

    ``kinds`` says whether each point has a fourth entry: 1 for an object, 0 for a hand, -1 for a fixture.
    """

    count: int = 768
    kinds: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "count", whole_number("points", self.count, 1, MOST_POINTS))
        true_or_false("kinds of points", self.kinds)

    @property
    def entries(self) -> int:
        """Number of observation entries of a cloud; the entries of each point are adjacent."""
        return self.count * POINT_ENTRIES[self.group]

    @property
    def group(self) -> str:
        """Name of the cloud's observation group: ``points``, or ``kind_points`` if a point has four entries."""
        return "kind_points" if self.kinds else "points"


class DepthSensor:
    """Puts point clouds into observations, and zeros the entries that depend on objects' states.

    A cloud begins at entry ``first`` of an observation. The attribute ``hidden`` lists the zeroed entries, ascending.
    """

    def __init__(self, scene: Scene, rule: PointsRule, first: int, device: torch.device) -> None:
        surfaces = sample(scene.model, max(CANDIDATES, 2 * rule.count))
        self._cloud = Cloud(surfaces, camera_of(scene.task), rule.count, rule.kinds, device)
        self._columns = slice(first, first + rule.entries)
        self.hidden = privileged_columns(scene)
        self._hidden = torch.tensor(self.hidden, dtype=torch.int64, device=device)

    def show(self, values: Tensor, position: Tensor, rotation: Tensor) -> None:
        """Zero the hidden entries of observations (n, d), and write the clouds into the cloud entries, in place.

        ``position`` (n, nbody, 3), in metres, and ``rotation`` (n, nbody, 3, 3) give the poses of the model's bodies in
        the world frame.
        """
        values.index_fill_(1, self._hidden, 0.0)
        values[:, self._columns] = self._cloud(position, rotation).flatten(1)


_OF_HANDS = tuple(f"{side}/" for side in SIDES)


def privileged_columns(scene: Scene) -> list[int]:
    """Return the ascending indices of the observation's entries that show an object's pose or motion.

    Every sensor that does not belong to a hand is replaced by NaN; entries that become NaN depend on such a sensor.
    """
    task = scene.task
    layout = scene.task.layout
    found = set[int]()
    for block, where in layout:
        if any(not sensor.startswith(_OF_HANDS) for sensor in block.sensors):
            found.update(range(where.start, where.stop))
    for name, values in task.observe(_without_objects(scene)).items():
        start = layout.range(name).start
        found |= {start + int(i) for i in values[0].isnan().nonzero()}
    return sorted(found)


def _without_objects(scene: Scene) -> TaskState:
    """Return a state of one environment in which all sensors of objects read NaN.

    The environment is at the scene's nominal start. Its task is the middle of the class's variation space.
    """
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.start_qpos[: scene.model.nq]
    mujoco.mj_forward(scene.model, data)
    sensors = torch.from_numpy(data.sensordata.copy())[None]
    for name, where in scene.sensors.items():
        if not name.startswith(_OF_HANDS):
            sensors[:, where] = torch.nan
    space = scene.task.variation_space
    low, high = (torch.tensor(ends, dtype=torch.float64) for ends in (space.low, space.high))
    return TaskState(sensors, scene.sensors, scene.task.frozen((0.5 * (low + high))[None]))

"""Which entries of an observation tell of an object's true state: found, not written down.

Every sensor that is of no hand is replaced by NaN: what becomes NaN, or is read from such a sensor, depends on it.
"""

import mujoco
import torch

from bidex_meta.hands.pair import SIDES
from bidex_meta.tasks.scene import Scene
from bidex_meta.tasks.state import TaskState

_OF_HANDS = tuple(f"{side}/" for side in SIDES)


def entries_of_objects(scene: Scene) -> list[int]:
    """Indices, ascending, of the entries from which an object's pose or motion could be read.

    Those of a hand stay, though its fingertips feel what they touch.
    """
    task, layout = scene.task, scene.task.layout
    found = {
        i
        for block, where in layout
        if any(not sensor.startswith(_OF_HANDS) for sensor in block.sensors)
        for i in range(where.start, where.stop)
    }
    for name, values in task.observe(_without_objects(scene)).items():
        start = layout.range(name).start
        found |= {start + int(i) for i in values[0].isnan().nonzero()}
    return sorted(found)


def _without_objects(scene: Scene) -> TaskState:
    """The nominal start of a task from the middle of the variation space, objects' sensors NaN, one row."""
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.start_qpos[: scene.model.nq]
    mujoco.mj_forward(scene.model, data)
    sensors = torch.from_numpy(data.sensordata.copy())[None]
    for name, where in scene.sensors.items():
        if not name.startswith(_OF_HANDS):
            sensors[:, where] = torch.nan
    space = scene.task.variation_space
    low, high = (torch.tensor(ends, dtype=torch.float64) for ends in (space.low, space.high))
    return TaskState(sensors, scene.sensors, scene.task.freeze((0.5 * (low + high))[None]))

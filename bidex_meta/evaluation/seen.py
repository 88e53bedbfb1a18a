"""What a row's depth camera sees, beside the picture of the row."""

from typing import Any

import numpy as np

from bidex_meta.points.cloud import Cloud, beside, camera_of, draw
from bidex_meta.points.depth_sensor import CANDIDATES
from bidex_meta.points.surfaces import sample


class SeenWorld:
    """A world whose pictures have the cloud of the row beside them: from its camera, then from the side.

    The cloud is made of the physics' state, whatever observations show: a policy that reads the state can be looked at
    too. Everything but ``render`` is the world's own.

    Args:
        world: One that draws, of scenes of our own.
        count: Points of a cloud.
    """

    def __init__(self, world: Any, count: int) -> None:
        self._world, self._count = world, count
        self._clouds: dict[int, Cloud] = {}
        for part in world.parts:
            part.group.engine.body_poses()  # from now on the engine gives them

    def __getattr__(self, name: str) -> Any:
        return getattr(self._world, name)

    def render(self, row: int = 0, width: int = 640, height: int = 480, camera: str | None = None) -> np.ndarray:
        """Three pictures side by side, (height, 3 width, 3), uint8; arguments as those of ``World.render``."""
        picture = self._world.render(row=row, width=width, height=height, camera=camera)
        cloud, eye = self._cloud(row)
        return np.concatenate((picture, *(draw(cloud, each, width, height) for each in (eye, beside(eye)))), axis=1)

    def _cloud(self, row: int) -> tuple[np.ndarray, Any]:
        slot = int(self._world.task_id[row])
        part, member = next((p, m) for p in self._world.parts for m in p.group.members if m.slot == slot)
        if slot not in self._clouds:
            surfaces = sample(member.scene.model, max(CANDIDATES, 2 * self._count))
            device = part.group.engine.device
            self._clouds[slot] = Cloud(surfaces, camera_of(member.scene.task), self._count, kinds=True, device=device)
        at = part.engine_rows[row : row + 1]
        position, rotation = part.group.engine.body_poses()
        cloud = self._clouds[slot](position[at], rotation[at])[0]
        return cloud.double().cpu().numpy(), camera_of(member.scene.task)

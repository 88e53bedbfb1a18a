"""Pictures of a row: its scene from a fixed camera, with its goal as a ghost."""

from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch

from bidex_meta.errors import BidexError
from bidex_meta.maths import wxyz

if TYPE_CHECKING:
    from bidex_meta.world.world import World

CAMERAS = {"front": (125.0, -25.0), "side": (180.0, -15.0), "top": (90.0, -75.0), "back": (-55.0, -25.0)}
"""Azimuth and elevation of the named views, degrees."""
_GHOST = np.array((0.25, 0.75, 0.40, 0.35), dtype=np.float32)


def render_row(world: "World", row: int, width: int, height: int, camera: str | None) -> np.ndarray:
    """A picture of a row, shape (height, width, 3), uint8.

    Raises:
        BidexError: Unknown camera, a row that does not exist, or no way to draw on this machine.
    """
    name = camera or "front"
    if name not in CAMERAS:
        raise BidexError(f"Expected a camera among {', '.join(CAMERAS)}, got {name!r}.")
    if not 0 <= row < world.num_envs:
        raise BidexError(f"Expected a row from 0 to {world.num_envs - 1}, got {row}.")
    part = next(p for p in world.parts if bool((p.group.rows == row).any()))
    engine_row = int((part.group.rows == row).nonzero()[0])
    model, data = part.group.engine.model(engine_row), part.group.engine.data(engine_row)
    try:
        renderer = mujoco.Renderer(model, height, width)
    except Exception as error:  # the drawing library raises errors of many kinds when it finds no display
        raise BidexError(
            f"Expected a way to draw, got {type(error).__name__}; without a screen set MUJOCO_GL=egl or osmesa."
        ) from error
    with renderer:
        renderer.update_scene(data, _camera(world, row, name))
        _add_ghosts(world, row, renderer.scene)
        return renderer.render()


def _camera(world: "World", row: int, name: str) -> mujoco.MjvCamera:
    view = mujoco.MjvCamera()
    task = world.slots[int(world.task_id[row])].task_class
    view.lookat[:] = task.camera_target
    view.distance = task.camera_distance
    view.azimuth, view.elevation = CAMERAS[name]
    return view


def _add_ghosts(world: "World", row: int, scene: mujoco.MjvScene) -> None:
    slot = int(world.task_id[row])
    task = world.slots[slot].task_class
    variation = torch.as_tensor(world.slots[slot].tasks[int(world.task_index[row])])[None]
    for pose, size in task.ghosts(task.freeze(variation)):
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, wxyz(pose[0, 3:]).numpy())
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(
            geom, mujoco.mjtGeom.mjGEOM_ELLIPSOID, np.array(size), pose[0, :3].numpy(), rotation, _GHOST
        )
        scene.ngeom += 1

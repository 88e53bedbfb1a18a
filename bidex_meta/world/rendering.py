"""Pictures of an environment: its scene from a fixed camera, with its goal as a ghost if observations show it."""

import threading
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np
import torch

from bidex_meta.engine.protocol import CAMERA, GHOST_GROUP
from bidex_meta.errors import BidexError, shortened
from bidex_meta.tasks.scene import dressed_spec
from bidex_meta.utils import gl_backend
from bidex_meta.utils.maths import wxyz

if TYPE_CHECKING:
    from bidex_meta.engine.protocol import Engine, Renderer
    from bidex_meta.tasks.base import TaskClass
    from bidex_meta.tasks.goals import Ghost
    from bidex_meta.tasks.scene import Scene
    from bidex_meta.world.groups import Member
    from bidex_meta.world.part import Part, PartedWorld

CAMERAS = {"front": None, "side": (180.0, -15.0), "top": (90.0, -75.0), "back": (-55.0, -25.0)}
"""Azimuth and elevation of the named views, degrees; None: the class's ``camera_angle``."""
_MOST_RENDERERS = 32
"""Maximum number of cached renderers: enough for a tiled film of all classes; each takes some megabytes."""
MOST_PIXELS = 1080
"""Edge of the largest square picture."""
_SMALL = 320
"""Pictures up to this width, pixels, are drawn without reflections and with coarser shadows, which is faster."""
GHOST_ALPHA = 0.35
"""Opacity of goals."""


class DrawnGhost(NamedTuple):
    """A goal of one environment as pictures show it: an ellipsoid in the world frame."""

    position: np.ndarray
    quaternion: np.ndarray
    """Orientation (w, x, y, z), as in MuJoCo."""
    size: np.ndarray
    """Semi-axes, metres."""
    colour: tuple[float, float, float]
    """Red, green and blue in [0, 1]."""


class Painter(threading.local):
    """Draws environments of a world; renderers are cached. A copy starts without renderers: they cannot be copied.

    A renderer draws only in the thread that made it. Each thread therefore has its own cache, which is freed when the
    thread ends.
    """

    def __init__(self) -> None:
        self._renderers: dict[tuple[int, int, int], tuple[mujoco.Renderer, mujoco.MjData]] = {}
        self._batches: dict[tuple[int, int], Renderer] = {}

    def __reduce__(self) -> tuple[type["Painter"], tuple[()]]:
        return Painter, ()

    def picture(self, world: "PartedWorld", env_id: int, width: int, height: int, camera: str | None) -> np.ndarray:
        """Draw an environment, shape (height, width, 3), uint8.

        Raises BidexError for an unknown camera or environment, too large a picture, or a machine that cannot draw.
        """
        name = "front" if camera is None else camera
        if not isinstance(name, str) or name not in CAMERAS:
            raise BidexError(f"Expected a camera among {', '.join(CAMERAS)}, got {shortened(name)}.")
        if not 0 <= env_id < world.num_envs:
            raise BidexError(f"Expected an env_id from 0 to {world.num_envs - 1}, got {env_id}.")
        engine, engine_row, scene = simulation(world, env_id)
        return self._draw(world, env_id, name, (width, height), scene, engine.placement()[engine_row])

    def pictures(self, world: "PartedWorld", size: int) -> torch.Tensor:
        """Return pictures (num_envs, size, size, 3), uint8, of all environments from their classes' own cameras.

        Environments of mujoco_warp are drawn on the engine's device, all of a slot at once. Environments of C MuJoCo
        are drawn one after another on the CPU.
        """
        pictures = torch.empty(world.num_envs, size, size, 3, dtype=torch.uint8, device=world.device)
        for part in world.parts:
            placement = part.group.engine.placement()
            if part.group.engine.has_renderer:
                for member, rows, state in part.states(part.group.take(world.task_index)):
                    goals = [] if world.hides_goals else member.scene.task.ghosts(state)
                    poses = [torch.cat((pose[:, :3], wxyz(pose[:, 3:])), dim=1) for pose, *_ in goals]
                    renderer = self._batch(part.group.engine, member, size, goals)
                    pictures[member.env_ids] = renderer.draw(torch.cat((placement[rows], *poses), dim=1))
                continue
            env_ids = part.group.env_ids.tolist()
            for member in part.group.members:
                for at in range(member.engine_rows.start, member.engine_rows.stop):
                    picture = self._draw(world, env_ids[at], "front", (size, size), member.scene, placement[at])
                    pictures[env_ids[at]] = torch.from_numpy(picture)
        return pictures

    def _batch(self, engine: "Engine", member: "Member", size: int, goals: "list[Ghost]") -> "Renderer":
        """Return the renderer of a member's environments."""
        key = member.slot, size
        if key not in self._batches:
            num = member.env_ids.stop - member.env_ids.start
            self._batches[key] = engine.renderer(stage(member.scene.task, goals), num, size, GHOST_ALPHA)
        return self._batches[key]

    def _draw(
        self,
        world: "PartedWorld",
        env_id: int,
        camera: str,
        size: tuple[int, int],
        scene: "Scene",
        placement: torch.Tensor,
    ) -> np.ndarray:
        renderer, data = self._renderer(scene.dressed, (int(world.task_id[env_id]), *size))
        pose(scene.dressed, data, placement)
        renderer.update_scene(data, _camera(world, env_id, camera))
        add_ghosts(ghosts(world, env_id), renderer.scene)
        return renderer.render()

    def _renderer(self, model: mujoco.MjModel, key: tuple[int, int, int]) -> tuple[mujoco.Renderer, mujoco.MjData]:
        """Return the cached renderer for a key: slot (all its environments have one model), width and height."""
        if key not in self._renderers:
            gl_backend.prepare()
            most = model.vis.global_.offwidth, model.vis.global_.offheight
            if not (0 < key[1] <= most[0] and 0 < key[2] <= most[1]):
                raise BidexError(
                    f"Expected a picture of at most {most[0]} x {most[1]} pixels, got {key[1]} x {key[2]}."
                )
            if len(self._renderers) >= _MOST_RENDERERS:
                self._renderers.pop(next(iter(self._renderers)))[0].close()
            small = key[1] <= _SMALL
            model.vis.quality.shadowsize, model.vis.quality.offsamples = (1024, 4) if small else (4096, 8)
            renderer = mujoco.Renderer(model, key[2], key[1])
            renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = not small
            self._renderers[key] = renderer, mujoco.MjData(model)
        return self._renderers[key]

    def close(self) -> None:
        """Free the renderers of this thread."""
        self._batches.clear()
        while self._renderers:
            self._renderers.popitem()[1][0].close()


def _camera(world: "PartedWorld", env_id: int, name: str) -> mujoco.MjvCamera:
    view = mujoco.MjvCamera()
    task = world.slots[int(world.task_id[env_id])].task_class
    view.lookat[:] = task.camera_target
    view.distance = task.camera_distance
    view.azimuth, view.elevation = CAMERAS[name] or task.camera_angle
    return view


def stage(task: "TaskClass", goals: "list[Ghost]") -> mujoco.MjModel:
    """Return a class's model for pictures, with the class's own camera and with a movable body for each goal.

    The renderer draws the goals' bodies translucently. In a placement (see ``Engine.placement``) the goals' poses
    follow those of the movable fixtures.
    """
    spec = dressed_spec(task)
    azimuth, elevation = np.radians(task.camera_angle)
    forward = np.array((np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)))
    right = np.array((np.sin(azimuth), -np.cos(azimuth), 0.0))
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.stack((right, np.cross(right, forward), -forward), axis=1).ravel())
    position = np.array(task.camera_target) - task.camera_distance * forward
    spec.worldbody.add_camera(name=CAMERA, pos=position, quat=quaternion, fovy=spec.visual.global_.fovy)
    for _, size, colour in goals:
        body = spec.worldbody.add_body(mocap=True)
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_ELLIPSOID, size=size, rgba=(*colour, 1.0), group=GHOST_GROUP,
            contype=0, conaffinity=0
        )  # fmt: skip
    return spec.compile()


def simulation(world: "PartedWorld", env_id: int) -> "tuple[Engine, int, Scene]":
    """Return the engine that simulates an environment, the environment's row in the engine, and its scene."""
    part, at = _part(world, env_id)
    scene = next(m.scene for m in part.group.members if m.engine_rows.start <= at < m.engine_rows.stop)
    return part.group.engine, at, scene


def _part(world: "PartedWorld", env_id: int) -> "tuple[Part, int]":
    """Return the ``Part`` of the world that holds an environment, and the environment's row in the part's engine."""
    part = next(p for p in world.parts if bool((p.group.env_ids == env_id).any()))
    return part, int((part.group.env_ids == env_id).nonzero()[0])


def pose(model: mujoco.MjModel, data: mujoco.MjData, placement: torch.Tensor) -> None:
    """Set ``data`` to a placement (a row of ``Engine.placement``), so that everything is drawn in its present pose."""
    numbers = placement.double().cpu().numpy()
    data.qpos[:] = numbers[: model.nq]
    mocap = numbers[model.nq :].reshape(-1, 7)
    data.mocap_pos[:] = mocap[:, :3]
    data.mocap_quat[:] = mocap[:, 3:]
    for part in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight):
        part(model, data)


def ghosts(world: "PartedWorld", env_id: int) -> list[DrawnGhost]:
    """Return the goals of an environment's task in the present state; the list is empty if the world hides goals.

    Every picture, film and view calls this function, so that none shows what observations hide.
    """
    if world.hides_goals:
        return []
    part, at = _part(world, env_id)
    rows = torch.tensor([at], device=part.group.engine.device)
    ((member, _, state),) = part.states(part.group.take(world.task_index), rows)
    found = []
    for goal, size, colour in member.scene.task.ghosts(state):
        numbers = goal[0].double().cpu()
        found.append(DrawnGhost(numbers[:3].numpy(), wxyz(numbers[3:]).numpy(), np.array(size), colour))
    return found


def add_ghosts(goals: list[DrawnGhost], scene: mujoco.MjvScene) -> None:
    """Add translucent goals to a scene that is about to be drawn."""
    rotation = np.zeros(9)
    for position, quaternion, size, colour in goals:
        mujoco.mju_quat2Mat(rotation, quaternion)
        geom = scene.geoms[scene.ngeom]
        rgba = np.array((*colour, GHOST_ALPHA), dtype=np.float32)
        mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_ELLIPSOID, size, position, rotation, rgba)
        scene.ngeom += 1

"""Frames of an acting policy: one environment, or one environment of each class as tiles."""

from collections.abc import Iterator, Sequence
from typing import Protocol, TypedDict, cast

import numpy as np
import torch
from typing_extensions import Unpack

from bidex_meta.agents import Agent
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.play import agent_step
from bidex_meta.runs.video import LABEL, tiled
from bidex_meta.world.cloud import Camera, Cloud, beside, camera_of, draw
from bidex_meta.world.contract import PooledWorld
from bidex_meta.world.depth_sensor import CANDIDATES, PointsRule
from bidex_meta.world.surfaces import sample
from bidex_meta.world.world import World
from bidex_meta.world.wrapper import PooledWorldWrapper


class Look(TypedDict, total=False):
    """Size and camera of a picture: the arguments of ``RenderedWorld.render``."""

    width: int
    height: int
    camera: str | None


class RenderedWorld(PooledWorld, Protocol):
    """A world that can be drawn; all worlds except Meta-World's can."""

    def render(self, env_id: int = 0, width: int = 640, height: int = 480, camera: str | None = None) -> np.ndarray:
        """Return a picture of an environment, (height, width, 3), uint8."""
        ...


def film_row(
    agent: Agent, world: PooledWorld, row: int, steps: int, seed: int, every: int | None = 1, **look: Unpack[Look]
) -> Iterator[np.ndarray]:
    """Yield frames of environment ``row`` during at most ``steps`` steps; stop earlier if the episode ends.

    The world is in autoreset mode DISABLED. A frame is yielded every ``every`` steps. If ``every`` is None, only the
    last state is yielded.
    """
    drawn = cast(RenderedWorld, world)
    obs, _ = world.reset(seed=seed)
    running = obs.new_ones(len(obs), dtype=torch.bool)
    agent.reset(running)
    for step in range(steps):
        if every is not None and step % every == 0:
            yield drawn.render(env_id=row, **look)
        obs, _, terminated, truncated, _ = agent_step(agent, world, obs, running)
        running = running & ~(terminated | truncated)
        if not bool(running[row]):
            break
    yield drawn.render(env_id=row, **look)


def film_tiles(
    agent: Agent,
    world: PooledWorld,
    rows: Sequence[int],
    steps: int,
    seed: int,
    every: int = 1,
    large: bool = False,
    **look: Unpack[Look],
) -> Iterator[np.ndarray]:
    """Yield frames of ``steps`` steps of several environments as tiles.

    When an episode ends, its environment starts a new one. An environment's name is green while its episode counts as a
    success: from the first success to the end of the episode, or, if success counts at the end, while the goal is held.
    The world is in autoreset mode DISABLED. ``width`` and ``height`` are those of a tile. With ``large`` there is an
    additional picture on the left, as high as all tiles. It shows one environment after the other, each for an equal
    share of the steps.
    """
    drawn = cast(RenderedWorld, world)
    names = [world.task_names[int(world.task_id[row])] for row in rows]
    obs, _ = world.reset(seed=seed)
    began = obs.new_ones(len(obs), dtype=torch.bool)
    solved = ~began
    agent.reset(began)
    for step in range(steps + 1):
        if step % every == 0:
            done = solved[list(rows)].tolist()
            frame = tiled([drawn.render(env_id=row, **look) for row in rows], names, done)
            if large:
                number = step * len(rows) // (steps + 1)
                picture = _large(drawn, rows[number], names[number], done[number], len(frame), look)
                frame = np.concatenate((picture, frame), axis=1)
            yield frame
        if step == steps:
            return
        obs, _, terminated, truncated, info = agent_step(agent, world, obs, began)
        solved = info["running"]["success"]
        ended = terminated | truncated
        if bool(ended.any()):
            obs, _ = world.reset(options={"reset_mask": ended})
            agent.reset(ended)
            solved = solved & ~ended


def _large(world: RenderedWorld, row: int, name: str, done: bool, height: int, look: Look) -> np.ndarray:
    """Return an enlarged tile of one environment, ``height`` pixels high, with its name as label.

    The picture has the same aspect ratio as in ``look``, and its width is even, as video codecs require.
    """
    inner = height - LABEL
    width = 2 * round(inner * look.get("width", 640) / look.get("height", 480) / 2)
    picture = world.render(row, width, inner, look.get("camera"))
    return tiled([picture], [name], [done])


def with_clouds(world: PooledWorld) -> PooledWorld:
    """Wrap a world so that its pictures also show the point cloud of the environment.

    Raises BidexError unless the world is a ``World``; for example, Meta-World's classes have no point clouds.
    """
    if not isinstance(world, World):
        raise BidexError("Only bidex-meta's own scenes have point clouds, not Meta-World's. Leave --points out.")
    count = (world.points or PointsRule()).count
    return CloudView(world, count)  # pyright: ignore[reportAbstractUsage]  # the wrapped world has all


class CloudView(PooledWorldWrapper):
    """A world whose pictures also show the environment's point cloud, from the class's camera and from the side.

    The cloud has ``count`` points. It shows the true state of the physics, even if observations hide a part of it.
    """

    def __init__(self, world: World, count: int) -> None:
        super().__init__(world)
        self._world = world
        self._count = count
        self._clouds: dict[int, Cloud] = {}
        for part in world.parts:
            part.group.engine.body_poses()  # from this call on, the engine computes the poses

    def render(self, env_id: int = 0, width: int = 640, height: int = 480, camera: str | None = None) -> np.ndarray:
        """Return three pictures side by side, (height, 3 width, 3), uint8; arguments are those of ``World.render``."""
        picture = self._world.render(env_id=env_id, width=width, height=height, camera=camera)
        cloud, eye = self._cloud(env_id)
        views = (draw(cloud, eye, width, height), draw(cloud, beside(eye), width, height))
        return np.concatenate((picture, *views), axis=1)

    def _cloud(self, env_id: int) -> tuple[np.ndarray, Camera]:
        slot = int(self._world.task_id[env_id])
        part = next(part for part in self._world.parts if slot in [member.slot for member in part.group.members])
        scene = next(member.scene for member in part.group.members if member.slot == slot)
        engine = part.group.engine
        camera = camera_of(scene.task)
        if slot not in self._clouds:
            surfaces = sample(scene.model, max(CANDIDATES, 2 * self._count))
            self._clouds[slot] = Cloud(surfaces, camera, self._count, kinds=True, device=engine.device)
        position, rotation = engine.body_poses()
        rows = part.engine_rows[env_id : env_id + 1]
        cloud = self._clouds[slot](position[rows], rotation[rows])[0]
        return cloud.double().cpu().numpy(), camera

"""Frames of a policy at work: of one environment, or of one of each class beside each other."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from bidex_meta.agents import Agent
from bidex_meta.runs.video import LABEL, tiled
from bidex_meta.world.cloud import Camera, Cloud, beside, camera_of, draw
from bidex_meta.world.depth_sensor import CANDIDATES
from bidex_meta.world.surfaces import sample
from bidex_meta.world.world import World


def film_row(
    agent: Agent, world: Any, row: int, steps: int, seed: int, every: int | None = 1, **look: Any
) -> Iterator[np.ndarray]:
    """Frames of environment ``row`` before and after at most so many steps; fewer where the episode ends.

    The world is in autoreset mode DISABLED. ``every``: steps from one frame to the next; None: the last state alone.
    ``look``: arguments of ``render``.
    """
    obs, _ = world.reset(seed=seed)
    agent.reset(obs.new_ones(len(obs), dtype=bool))
    for step in range(steps):
        if every is not None and step % every == 0:
            yield world.render(env_id=row, **look)
        obs, _, terminated, truncated, _ = world.step(agent.eval_action(obs))
        if bool(terminated[row] | truncated[row]):
            break
    yield world.render(env_id=row, **look)


def film_tiles(
    agent: Agent,
    world: Any,
    rows: Sequence[int],
    steps: int,
    seed: int,
    every: int = 1,
    large: bool = False,
    **look: Any,
) -> Iterator[np.ndarray]:
    """So many steps of several environments, tiles beside each other; each begins its next episode when one ends.

    An environment's name is green while its episode counts as a success: from the first success to the end of the
    episode, or, where success counts at the end, while the goal is held. The world is in autoreset mode DISABLED; the
    size is that of a tile. ``large``: left of the tiles, as high as they are, one environment after the other, each for
    an equal share of the steps.
    """
    names = [world.task_names[int(world.task_id[row])] for row in rows]
    obs, _ = world.reset(seed=seed)
    began = obs.new_ones(len(obs), dtype=bool)
    solved = ~began
    agent.reset(began)
    for step in range(steps + 1):
        if step % every == 0:
            done = solved[list(rows)].tolist()
            frame = tiled([world.render(env_id=row, **look) for row in rows], names, done)
            if large:
                at = step * len(rows) // (steps + 1)
                frame = np.concatenate((_large(world, rows[at], names[at], done[at], len(frame), look), frame), axis=1)
            yield frame
        if step == steps:
            return
        obs, _, terminated, truncated, info = world.step(agent.eval_action(obs))
        solved = info["running"]["success"]
        ended = terminated | truncated
        if bool(ended.any()):
            obs, _ = world.reset(options={"reset_mask": ended})
            agent.reset(ended)
            solved = solved & ~ended


def _large(world: Any, row: int, name: str, done: bool, height: int, look: dict[str, Any]) -> np.ndarray:
    """A tile of that height, of the others' shape; its width is even, as films need it."""
    inner = height - LABEL
    width = 2 * round(inner * look["width"] / look["height"] / 2)
    picture = world.render(env_id=row, **look | {"width": width, "height": inner})
    return tiled([picture], [name], [done])


class CloudView:
    """A world whose pictures have the environment's point cloud beside them: from its camera, then from the side.

    The cloud, of ``count`` points, is that of the physics' state, whatever observations show. Everything but ``render``
    is the world's own.
    """

    def __init__(self, world: World, count: int) -> None:
        self._world = world
        self._count = count
        self._clouds: dict[int, Cloud] = {}
        for part in world.parts:
            part.group.engine.body_poses()  # from now on the engine gives them

    def __getattr__(self, name: str) -> Any:
        return getattr(self._world, name)

    def render(self, env_id: int = 0, width: int = 640, height: int = 480, camera: str | None = None) -> np.ndarray:
        """Three pictures side by side, (height, 3 width, 3), uint8; arguments as those of ``World.render``."""
        picture = self._world.render(env_id=env_id, width=width, height=height, camera=camera)
        cloud, eye = self._cloud(env_id)
        return np.concatenate((picture, *(draw(cloud, each, width, height) for each in (eye, beside(eye)))), axis=1)

    def _cloud(self, env_id: int) -> tuple[np.ndarray, Camera]:
        slot = int(self._world.task_id[env_id])
        part, member = next((p, m) for p in self._world.parts for m in p.group.members if m.slot == slot)
        if slot not in self._clouds:
            surfaces = sample(member.scene.model, max(CANDIDATES, 2 * self._count))
            device = part.group.engine.device
            self._clouds[slot] = Cloud(surfaces, camera_of(member.scene.task), self._count, kinds=True, device=device)
        at = part.engine_rows[env_id : env_id + 1]
        position, rotation = part.group.engine.body_poses()
        cloud = self._clouds[slot](position[at], rotation[at])[0]
        return cloud.double().cpu().numpy(), camera_of(member.scene.task)

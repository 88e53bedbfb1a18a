"""Frames of a policy at work: of one row, or of a row of each class beside each other."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from bidex_meta.agents import Agent
from bidex_meta.record.video import tiled


def film_row(
    agent: Agent, world: Any, row: int, steps: int, seed: int, every: int | None = 1, **look: Any
) -> Iterator[np.ndarray]:
    """The states before and after so many steps; fewer where the episode ends.

    Args:
        agent: The policy.
        world: A world that draws, in autoreset mode DISABLED.
        row: Which row.
        steps: Steps at most.
        seed: Of the start.
        every: Steps from one frame to the next; None: the last state alone.
        look: ``width``, ``height``, ``camera`` of ``World.render``.
    """
    obs, _ = world.reset(seed=seed)
    agent.reset(obs.new_ones(len(obs), dtype=bool))
    for step in range(steps):
        if every is not None and step % every == 0:
            yield world.render(row=row, **look)
        obs, _, terminated, truncated, _ = world.step(agent.eval_action(obs))
        if bool(terminated[row] | truncated[row]):
            break
    yield world.render(row=row, **look)


def film_tiles(
    agent: Agent, world: Any, rows: Sequence[int], steps: int, seed: int, every: int = 1, **look: Any
) -> Iterator[np.ndarray]:
    """So many steps of several rows beside each other; a row that ends begins its next episode.

    The name of a row is green from its first success on, until its episode ends.

    Args:
        agent: The policy.
        world: A world that draws, in autoreset mode DISABLED.
        rows: Which rows, one for each tile.
        steps: Steps.
        seed: Of the starts.
        every: Steps from one frame to the next.
        look: As in ``film_row``; the size is that of a tile.
    """
    names = [world.task_names[int(world.task_id[row])] for row in rows]
    obs, _ = world.reset(seed=seed)
    began = obs.new_ones(len(obs), dtype=bool)
    solved = ~began
    agent.reset(began)
    for step in range(steps + 1):
        if step % every == 0:
            yield tiled([world.render(row=row, **look) for row in rows], names, solved[list(rows)].tolist())
        if step == steps:
            return
        obs, _, terminated, truncated, info = world.step(agent.eval_action(obs))
        solved = solved | info["success"]
        ended = terminated | truncated
        if bool(ended.any()):
            obs, _ = world.reset(options={"reset_mask": ended})
            agent.reset(ended)
            solved = solved & ~ended

"""Draw a picture or a film of an acting policy into a file."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bidex_meta.agents import Agent
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.filming import Look, film_row, film_tiles, with_clouds
from bidex_meta.rules import CONTROL_RATE
from bidex_meta.runs import video
from bidex_meta.runs.progress import counted
from bidex_meta.world.contract import PooledWorld


@dataclass(frozen=True)
class Film:
    """A picture (``.png``) or a film (other suffixes) of one environment, or of several as tiles."""

    out: Path
    seed: int = 0
    steps: int | None = None  # steps; None: 0 for a picture, one episode for a film (if ``tiled``, the longest one)
    tiled: bool = False
    large: bool = False  # if ``tiled``: also show one environment at a time enlarged
    every: int | None = None  # steps per frame; None: 1, or 2 if ``tiled``
    width: int | None = None  # pixels, of a tile if ``tiled``; None: 640, or 240 if ``tiled``
    height: int | None = None  # None: three quarters of the width
    camera: str | None = None
    points: bool = False  # also draw the environment's point cloud

    @property
    def is_picture(self) -> bool:
        """Return whether the file is a picture."""
        return self.out.suffix.lower() == ".png"

    @property
    def size(self) -> tuple[int, int]:
        """Return the width and the height of the film, or of each tile, in pixels."""
        width = self.width or (240 if self.tiled else 640)
        return width, self.height or width * 3 // 4

    def check(self) -> None:
        """Raise BidexError if films cannot be written, or cannot have this size."""
        if self.out.suffix.lower() != ".mp4":
            return
        width, height = self.size
        if width % 2 or height % 2:
            raise BidexError(f"A film needs an even width and height, not {width} x {height}.")
        video.check_films()

    def write(self, agent: Agent, world: PooledWorld, rows: Sequence[int]) -> None:
        """Let an agent act in a world (mode DISABLED) and draw the environments ``rows``.

        Without ``tiled`` only the first environment is drawn.
        """
        if self.points:
            world = with_clouds(world)
        if self.steps is not None:
            steps = self.steps
        elif self.is_picture:
            steps = 0
        else:
            steps = int(world.max_episode_steps[list(rows)].max())
        every = self.every or (2 if self.tiled else 1)
        frames = counted(self._frames(agent, world, rows, steps, every), self._count(steps, every), "frames")
        if self.is_picture:
            for frame in frames:  # a tiled picture needs a frame after the first one
                video.write_image(self.out, frame)
        else:
            video.write_film(self.out, frames, CONTROL_RATE / every)

    def _frames(
        self, agent: Agent, world: PooledWorld, rows: Sequence[int], steps: int, every: int
    ) -> Iterator[np.ndarray]:
        width, height = self.size
        look: Look = {"width": width, "height": height, "camera": self.camera}
        if self.tiled:
            step = max(steps, 1) if self.is_picture else every
            return film_tiles(agent, world, rows, steps, self.seed, step, self.large, **look)
        return film_row(agent, world, rows[0], steps, self.seed, None if self.is_picture else every, **look)

    def _count(self, steps: int, every: int) -> int:
        if not self.is_picture:
            return steps // every + 1
        return 1 + (self.tiled and steps > 0)

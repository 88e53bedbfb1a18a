"""A world around a world: what recorders, statistics and the like are made from.

Take the class of what is wrapped, so that evaluation and learners still see what it can do, and override what shall be
done besides::

    class Count(WorldWrapper):
        steps = 0

        def step(self, action):
            self.steps += 1
            return super().step(action)
"""

from typing import Any

import numpy as np
from torch import Tensor

from bidex_meta.world.contract import PooledWorld, TaskWorld, VectorWorld


class WorldWrapper(VectorWorld):
    """A ``VectorWorld`` that passes everything on to another one.

    Args:
        world: What is wrapped. Nothing of it is copied: attributes are asked of it each time, its own ones too.
    """

    def __init__(self, world: VectorWorld) -> None:
        self.world = world

    def __getattr__(self, name: str) -> Any:
        if name == "world":  # not made yet, as in copies
            raise AttributeError(name)
        return getattr(self.world, name)

    @property
    def unwrapped(self) -> Any:
        """The world within all wrappers."""
        return getattr(self.world, "unwrapped", self.world)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        """Starts episodes; see ``VectorWorld``."""
        return self.world.reset(seed=seed, options=options)

    def step(self, action: Tensor, /) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Takes actions (N, a); see ``VectorWorld``."""
        return self.world.step(action)

    def state_dict(self) -> dict[str, Any]:
        """The wrapped world's state: with or without the wrapper a run continues from it."""
        return self.world.state_dict()

    def load_state_dict(self, state: dict[str, Any], /) -> None:
        """Puts back what ``state_dict`` gave."""
        self.world.load_state_dict(state)

    def close(self) -> None:
        """Frees the wrapped world."""
        self.world.close()


class TaskWorldWrapper(WorldWrapper, TaskWorld):
    """The same around a ``TaskWorld``."""

    world: TaskWorld

    def __init__(self, world: TaskWorld) -> None:
        super().__init__(world)


class PooledWorldWrapper(TaskWorldWrapper, PooledWorld):
    """The same around a ``PooledWorld``."""

    world: PooledWorld

    def __init__(self, world: PooledWorld) -> None:
        super().__init__(world)

    @property
    def pools(self) -> list[np.ndarray]:
        """Tasks of each slot, each (n, size of a variation)."""
        return self.world.pools

    def set_tasks(self, pools: dict[str, np.ndarray], /) -> None:
        """Gives slots other pools; see ``PooledWorld``."""
        self.world.set_tasks(pools)

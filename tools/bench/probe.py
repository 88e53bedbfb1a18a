"""Real states on mujoco_warp: C MuJoCo plays a class, and an engine on Warp's CPU device takes its states over."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import torch

from bidex_meta.benchmark import make_task_world
from bidex_meta.engine.capacity import room_for
from bidex_meta.engine.switches import Switches
from bidex_meta.witness.demonstrators import Scripted
from bidex_meta.witness.scripts import scripts_of
from bidex_meta.world import World
from tools.bench.stability import rough_actions

if TYPE_CHECKING:
    from bidex_meta.engine.warp import WarpEngine

_NOISE = 0.1
"""Standard deviation of the noise on a script's actions."""


class Probe:
    """A world of one class, played by the class's script (with noise) or by rough actions, and a Warp engine."""

    def __init__(
        self, name: str, num_envs: int, seed: int = 0, threads: int | None = None, moving: bool = True,
        switches: str = ""
    ) -> None:  # fmt: skip
        """Make the world and the engine, and reset the world; ``switches`` apply to the Warp engine."""
        from bidex_meta.engine.warp import WarpEngine  # takes seconds to import

        self.world: World = make_task_world(
            name, num_envs, "cpu", seed=seed, autoreset_mode="DISABLED", threads=threads, moving_base=moving
        )
        (self._part,) = self.world.parts
        self.substeps: int = self._part.substeps
        theirs = self._part.group.engine
        on = Switches.of(switches)
        models = [theirs.model(row) for row in range(num_envs)]
        task = self.world.slots[0].task_class
        room = on.room(models[0], room_for([task.needs]))
        self.engine: WarpEngine = WarpEngine(on.models(models), range(num_envs), room, incremental=on.incremental)
        self.scripted = task.moving_base and task.name in scripts_of(task.rules)
        self._action, self._begin = _actor(self.world, self.scripted, seed)
        self.world.reset(seed=seed)
        self._begin(torch.ones(num_envs, dtype=torch.bool))

    def play(self, steps: int, every: int) -> Iterator[int]:
        """Step C MuJoCo; after every ``every``-th control step load its state into the Warp engine and yield."""
        for step in range(1, steps + 1):
            info = self.world.step(self._action())[-1]
            if step % every == 0:
                self.engine.load_state_dict(self._part.group.engine.state_dict())
                yield step
            ended = info["_final_obs"]
            if ended.any():
                self.world.reset(options={"reset_mask": ended})
                self._begin(ended)

    def step(self) -> None:
        """Play a control step on the Warp engine without a graph, so that Python sees every launch."""
        engine = self.engine
        engine._substeps = self.substeps
        with engine._on_device():
            engine._advance()


def _actor(
    world: World, scripted: bool, seed: int
) -> tuple[Callable[[], torch.Tensor], Callable[[torch.Tensor], None]]:
    """Return a function that returns the next actions, and a function that begins episodes in the rows of a mask."""
    if scripted:
        script = Scripted(world, noise=_NOISE, seed=seed)
        return lambda: script.eval_action(torch.empty(0)), script.reset
    generator = torch.Generator().manual_seed(seed)
    held = torch.zeros(world.num_envs, world.action_size)
    left = torch.zeros(world.num_envs, dtype=torch.int64)
    return lambda: rough_actions(held, left, generator), lambda mask: None

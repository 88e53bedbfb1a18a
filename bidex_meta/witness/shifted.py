"""The start of a witness in every row of a world, its objects a little elsewhere: where demonstrations begin."""

from typing import Any

import torch
from torch import Tensor

from bidex_meta.errors import BidexError
from bidex_meta.witness.simulator import SEED, task_slot
from bidex_meta.world import World
from bidex_meta.world.wrapper import PooledWorldWrapper


class ShiftedStarts(PooledWorldWrapper):
    """A world of one class's task 0 whose rows all begin where its witness does.

    Every object and fixture is shifted in the plane: each its own way, by up to ``shift``, evenly over the disc.

    Args:
        name: The class.
        rows: Rows.
        shift: The most by which anything is shifted, metres.
        threads: Engine threads; None takes all CPUs.

    Raises:
        BidexError: There is no such class.
    """

    world: World

    def __init__(self, name: str, rows: int, shift: float, threads: int | None = None) -> None:
        super().__init__(World([task_slot(name)], rows, autoreset_mode="DISABLED", seed=SEED, threads=threads))
        self._shift = shift

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        """Begins all rows anew.

        Args:
            seed: Of the shifts.
            options: None.

        Raises:
            BidexError: A mask of rows: all begin together.
        """
        if options:
            raise BidexError("Shifted starts begin all rows together. Leave options out.")
        self.world.reset(seed=SEED)
        (part,) = self.world.parts
        engine, rows = part.group.engine, self.num_envs
        starts = engine.placement()[0].expand(rows, -1).clone()
        generator = torch.Generator().manual_seed(SEED if seed is None else seed)
        for name, where in part.group.members[0].scene.qpos.items():
            if "/" in name:  # a hand's
                continue
            angle, size = torch.rand(2, rows, generator=generator, dtype=starts.dtype)
            way = torch.stack([(2.0 * torch.pi * angle).cos(), (2.0 * torch.pi * angle).sin()], 1)
            starts[:, where.start : where.start + 2] += self._shift * size.sqrt()[:, None] * way
        engine.reset(torch.ones(rows, dtype=torch.bool), starts)
        # The world's own way to take over a state, so that its observations are of these starts.
        action = torch.zeros(self.world.action_space.shape)
        obs = part.observe(list(part.states(self.world.task_index)), action)
        self.world.load_state_dict(self.world.state_dict() | {"observation": obs})
        return obs.clone(), {}

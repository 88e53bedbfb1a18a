"""Plays a witness again: from its start, and from starts that are shifted by a tenth of a millimetre."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np
import torch

from bidex_meta.witness.simulator import Simulator
from bidex_meta.witness.store import Witness

SHIFTED = 10
"""Shifted starts that a witness is tried from."""
NEEDED = 8
"""Of these so many must succeed."""


@dataclass(frozen=True)
class Replay:
    """What a replay showed."""

    total: float
    """Return from the unshifted start."""
    first_success: int | None
    """Index of its first successful step."""
    succeeded: int
    """Shifted starts that succeed."""
    depths: torch.Tensor
    """Deepest contact after each step from each start, metres, shape (steps, 1 + shifted starts)."""

    @property
    def deepest(self) -> float:
        """Deepest contact from the unshifted start, metres: small unless something was passed through."""
        return float(self.depths[:, 0].max())

    @property
    def found(self) -> bool:
        """Whether this counts as a witness: it succeeds, and so do eight of ten shifted starts."""
        return self.first_success is not None and self.succeeded >= NEEDED


def frames(
    name: str, witness: Witness, at: Collection[int] | None = None, camera: str | None = None, **size: int
) -> Iterator[np.ndarray]:
    """Pictures of a witness, (height, width, 3) uint8: after as many steps as ``at`` says (0: the start).

    None: after every step.
    """
    simulator = Simulator(name, 1, threads=1)
    for played in range(len(witness.actions) + 1):
        if at is None or played in at:
            yield simulator.picture(camera=camera, **size)
        if played < len(witness.actions):
            simulator.play(torch.from_numpy(witness.actions[played])[None, None])
    simulator.close()


def replay(name: str, witness: Witness, threads: int | None = None) -> Replay:
    """Plays a witness of a class from its start and from ten shifted ones."""
    simulator = Simulator(name, 1 + SHIFTED, threads)
    simulator.load(simulator.starts(SHIFTED))
    actions = torch.from_numpy(witness.actions)
    depths: list[list[float]] = []
    everyone = range(simulator.num)
    repeated = actions[:, None].expand(-1, simulator.num, -1)
    trace = simulator.play(repeated, lambda: depths.append([simulator.contact_depth(i) for i in everyone]))
    simulator.close()
    steps = trace.success[:, 0].nonzero().flatten().tolist()
    won = trace.success.any(dim=0)
    first = steps[0] if steps else None
    return Replay(float(trace.rewards[:, 0].sum()), first, int(won[1:].sum()), torch.tensor(depths))

"""What the world asks of an engine."""

from typing import Protocol

import torch
from torch import Tensor


class Engine(Protocol):
    """A batch of simulations of equal structure.

    The views are created once and stay; the world writes ``qpos``, ``qvel``, ``ctrl`` and ``xfrc_applied`` in place.

    Attributes:
        num: Number of simulations.
        device: Where the views live.
        qpos: Positions, shape (num, nq).
        qvel: Velocities, shape (num, nv).
        ctrl: Position targets, shape (num, nu).
        xfrc_applied: World-frame force and torque at bodies' centres of mass, shape (num, nbody, 6).
        sensordata: Sensor values, shape (num, nsensordata).
    """

    num: int
    device: torch.device
    qpos: Tensor
    qvel: Tensor
    ctrl: Tensor
    xfrc_applied: Tensor
    sensordata: Tensor

    def step(self, substeps: int, active: Tensor | None = None) -> None:
        """Advances all simulations, or those of the mask ``active`` (num,), and refreshes their sensors.

        Sensors of positions and velocities then describe the new state; those of forces the last substep.
        """
        ...

    def placement(self) -> Tensor:
        """What ``reset`` takes, of every simulation as it stands, a copy. Shape (num, nq + 7 nmocap)."""
        ...

    def unstable(self) -> Tensor:
        """Which simulations broke (bad numbers, non-finite values, no room for contacts) since their last reset.

        Shape (num,), bool.
        """
        ...

    def reset(self, mask: Tensor, start: Tensor) -> None:
        """Starts the simulations of a mask (num,) anew.

        Args:
            mask: Which simulations, shape (num,), bool.
            start: Start positions: ``qpos``, then position and quaternion (w, x, y, z) of each fixture that may stand
                elsewhere from task to task. On the C engine one row for each true entry, shape (k, nq + 7 nmocap); on
                the Warp engine, which must not count them, a row for every simulation, shape (num, nq + 7 nmocap), and
                those outside the mask are ignored.
        """
        ...

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that decides the future of the simulations, copied."""
        ...

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Puts back what ``state_dict`` gave."""
        ...

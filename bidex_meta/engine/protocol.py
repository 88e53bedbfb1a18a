"""What the world asks of an engine."""

from collections.abc import Callable, Sequence
from typing import Protocol

import mujoco
import torch
from torch import Tensor

from bidex_meta.engine.capacity import Capacity


class Engine(Protocol):
    """A batch of simulations of equal structure.

    The views are created once and stay; the world writes ``qpos``, ``qvel``, ``ctrl`` and ``xfrc_applied`` in place.
    Whatever it writes, a step costs a broken row no more than others: it is looked for before each step
    (``health.py``) and goes on from the model's reference pose until its reset.

    Attributes:
        num: Number of simulations.
        device: Where the views live.
        masked: Whether the engine is of an accelerator's kind: resets are masked writes of full size, and nothing in
            a step may wait for a value or have a shape that depends on one.
        qpos: Positions, shape (num, nq).
        qvel: Velocities, shape (num, nv).
        ctrl: Position targets, shape (num, nu).
        xfrc_applied: World-frame force and torque at bodies' centres of mass, shape (num, nbody, 6).
        sensordata: Sensor values, shape (num, nsensordata).
    """

    num: int
    device: torch.device
    masked: bool
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

    def body_poses(self) -> tuple[Tensor, Tensor]:
        """Where all bodies stand, of the state that sensors describe: views that each step writes anew.

        Returns:
            Positions (num, nbody, 3), metres, and rotation matrices (num, nbody, 3, 3), world frame.
        """
        ...

    def unstable(self) -> Tensor:
        """Which simulations broke (numbers out of bounds or not finite, no room for contacts) since their last reset.

        Shape (num,), bool.
        """
        ...

    def warnings(self) -> Tensor:
        """How many kinds of trouble each simulation has told since its last reset. Shape (num,), int64."""
        ...

    def reset(self, mask: Tensor, start: Tensor) -> None:
        """Starts the simulations of a mask (num,) anew.

        Args:
            mask: Which simulations, shape (num,), bool.
            start: Start positions: ``qpos``, then position and quaternion (w, x, y, z) of each fixture that may stand
                elsewhere from task to task. One row for each true entry, shape (k, nq + 7 nmocap); where the engine is
                ``masked`` and must not count them one for every simulation, shape (num, nq + 7 nmocap), of which those
                outside the mask are ignored.
        """
        ...

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that decides the future of the simulations, copied."""
        ...

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Puts back what ``state_dict`` gave.

        Raises:
            BidexError: A state of another model or number of rows, or one with numbers that are not finite.
        """
        ...

    def model(self, row: int) -> mujoco.MjModel:
        """The model of a simulation, for pictures and checks."""
        ...

    def data(self, row: int) -> mujoco.MjData:
        """A copy of a simulation's data, forwarded by C MuJoCo, for pictures and checks."""
        ...

    def contact_depth(self, row: int) -> float:
        """Deepest penetration among a simulation's contacts, metres, 0 without contact."""
        ...


EngineMaker = Callable[[Sequence[mujoco.MjModel], Sequence[int], Capacity], Engine]
"""Makes an engine of models of equal structure, for each simulation the index of its model, and room for contacts."""

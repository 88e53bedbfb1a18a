"""What the world asks of an engine."""

from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

import mujoco
import torch
from torch import Tensor

from bidex_meta.engine.capacity import Capacity


class Engine(Protocol):
    """A batch of simulations of equal structure.

    The views are created once and stay; the world writes ``qpos``, ``qvel``, ``ctrl`` and ``xfrc_applied`` in place.
    Whatever it writes, a step costs a broken row no more than others: it is looked for before each step (``health.py``)
    and continues from the model's reference pose until its reset.
    """

    num: int
    device: torch.device
    masked: bool
    """Whether the engine is of an accelerator's kind: resets are masked writes of full size, and nothing in a step may
    wait for a value or have a shape that depends on one."""
    qpos: Tensor  # shape (num, nq)
    qvel: Tensor  # shape (num, nv)
    ctrl: Tensor  # position targets, shape (num, nu)
    xfrc_applied: Tensor  # world-frame force and torque at bodies' centres of mass, shape (num, nbody, 6)
    sensordata: Tensor  # shape (num, nsensordata)
    _state: dict[str, Tensor]  # views of what a state holds
    _mocap: list[Tensor]  # positions and quaternions of fixtures that may stand elsewhere, or nothing

    def step(self, substeps: int, active: Tensor | None = None) -> None:
        """Advances all simulations, or those of the mask ``active`` (num,), and refreshes their sensors.

        Sensors of positions and velocities then describe the new state; those of forces the last substep.
        """

    def placement(self) -> Tensor:
        """What ``reset`` takes, of every simulation as it stands, a copy. Shape (num, nq + 7 nmocap)."""
        if not self._mocap:
            return self.qpos.clone()
        return torch.cat((self.qpos, torch.cat(self._mocap, dim=2).flatten(1)), dim=1)

    def body_poses(self) -> tuple[Tensor, Tensor]:
        """Positions (num, nbody, 3), metres, and rotation matrices (num, nbody, 3, 3) of all bodies, world frame.

        Of the state that sensors describe: views that each step writes anew.
        """
        ...

    def unstable(self) -> Tensor:
        """Which broke (numbers out of bounds or not finite, no room for contacts) since their reset, bool (num,)."""
        ...

    def warnings(self) -> Tensor:
        """How many kinds of trouble each simulation has reported since its last reset. Shape (num,), int64."""
        ...

    def reset(self, mask: Tensor, start: Tensor) -> None:
        """Starts the simulations of a mask (num,), bool, anew.

        ``start``: ``qpos``, then position and quaternion (w, x, y, z) of each fixture that may stand elsewhere from
        task to task. One row for each true entry, (k, nq + 7 nmocap); where the engine is ``masked`` and must not count
        them one for every simulation, of which those outside the mask are ignored.
        """

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that decides the future of the simulations, copied."""
        return {name: value.clone() for name, value in self._state.items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restores a ``state_dict``; BidexError for one of another model or number of rows, or not finite."""

    def expand(self, names: Iterable[str]) -> dict[str, Tensor]:
        """Fields of the model that each simulation has for itself from now on: views (num, n, k) to write, by name.

        They hold what was; fields that the engine does not have are left out. What follows from them is the caller's.
        """
        ...

    def model(self, row: int) -> mujoco.MjModel:
        """The model of a simulation, for pictures and checks."""

    def data(self, row: int) -> mujoco.MjData:
        """A copy of a simulation's data, forwarded by C MuJoCo, for pictures and checks."""

    def contact_depth(self, row: int) -> float:
        """Deepest penetration among a simulation's contacts, metres, 0 without contact."""
        ...


EngineMaker = Callable[[Sequence[mujoco.MjModel], Sequence[int], Capacity], Engine]
"""Makes an engine of models of equal structure, for each simulation the index of its model, and room for contacts."""

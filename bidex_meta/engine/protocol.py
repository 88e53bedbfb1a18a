"""The protocol between the world and an engine."""

from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

import mujoco
import torch
from torch import Tensor

from bidex_meta.engine.capacity import Capacity
from bidex_meta.errors import BidexError

CAMERA = "picture"
"""Name of the camera whose view an engine's renderer draws."""
GHOST_GROUP = 4
"""Group of geoms that an engine's renderer draws translucent."""


class Renderer(Protocol):
    """Draws many environments of one model at once."""

    def draw(self, placement: Tensor) -> Tensor:
        """Return one picture of each environment, shape (num, edge, edge, 3), uint8.

        A row of ``placement`` (num, nq + 7 nmocap) holds the positions of one environment: ``qpos``, then the position
        and quaternion of each mocap body.
        """
        ...


class Engine(Protocol):
    """A batch of simulations whose models have the same structure.

    The tensors of the state have one row per simulation. They are views that stay the same from step to step; the
    world writes ``qpos``, ``qvel``, ``ctrl`` and ``xfrc_applied`` in place.

    Each step first looks for simulations with non-finite or too large numbers (``health.py``). Such a simulation
    continues from the model's reference pose until its reset, so it takes no more time than the others.
    """

    num: int
    device: torch.device
    avoids_syncs: bool
    """True if the engine suits accelerators: resets write all rows under a mask, and nothing in a step may wait for a
    value or have a shape that depends on a value."""
    has_renderer: bool = False
    """True if the engine draws all environments at once on its device (``renderer``)."""
    qpos: Tensor  # shape (num, nq)
    qvel: Tensor  # shape (num, nv)
    ctrl: Tensor  # position targets, shape (num, nu)
    xfrc_applied: Tensor  # world-frame force and torque at bodies' centres of mass, shape (num, nbody, 6)
    sensordata: Tensor  # shape (num, nsensordata)
    _state: dict[str, Tensor]  # views of the fields in a saved state
    _mocap: list[Tensor]  # positions and quaternions of movable fixtures, or empty

    def step(self, substeps: int, active: Tensor | None = None) -> None:
        """Advance all simulations, or those of the mask ``active`` (num,), and refresh their sensors.

        Position and velocity sensors then describe the new state; force sensors describe the last substep.
        """

    def placement(self) -> Tensor:
        """Return a copy of all present positions, (num, nq + 7 nmocap), in the form that ``reset`` accepts.

        Each row holds ``qpos``, then the position and quaternion (w, x, y, z) of each mocap body.
        """
        if not self._mocap:
            return self.qpos.clone()
        return torch.cat((self.qpos, torch.cat(self._mocap, dim=2).flatten(1)), dim=1)

    def body_poses(self) -> tuple[Tensor, Tensor]:
        """Return the positions (num, nbody, 3), metres, and rotation matrices (num, nbody, 3, 3) of all bodies.

        Both are in the world frame and from the same moment as the sensors. They are views, which each step overwrites.
        """
        ...

    def unstable(self) -> Tensor:
        """Return which simulations broke since their reset (bad numbers or too many contacts), bool (num,)."""
        ...

    def warnings(self) -> Tensor:
        """Return how many kinds of warnings each simulation has had since its last reset. Shape (num,), int64.

        mujoco_warp does not distinguish kinds: the number is 1 if the simulation broke, otherwise 0.
        """
        ...

    def reset(self, mask: Tensor, start: Tensor) -> None:
        """Restart the simulations whose entry in ``mask`` (num,), bool, is true, at the positions in ``start``.

        A row of ``start`` holds ``qpos``, then the position and quaternion (w, x, y, z) of each mocap body (a fixture
        whose pose differs from task to task). ``start`` has one row for each true entry of the mask, (k, nq + 7
        nmocap). If the engine's attribute ``avoids_syncs`` is True, ``start`` has one row for every simulation instead,
        and rows outside the mask are ignored: counting true entries would make the host wait for the device.
        """

    def state_dict(self) -> dict[str, Tensor]:
        """Return a copy of everything that decides the future of the simulations."""
        return {name: value.clone() for name, value in self._state.items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore a ``state_dict``; raise BidexError if its model or number of rows differs, or if it is not finite."""

    def expand(self, names: Iterable[str]) -> dict[str, Tensor]:
        """Give each simulation its own copy of the named model fields, and return writable views (num, n, k) by name.

        The views hold the old values at first. Fields that the engine does not have are left out. After a change, the
        caller must also update the fields that MuJoCo derives from the changed ones.
        """
        ...

    def model(self, row: int) -> mujoco.MjModel:
        """Return the model of a simulation, for pictures and checks."""

    def data(self, row: int) -> mujoco.MjData:
        """Return a copy of a simulation's data, forwarded by C MuJoCo, for pictures and checks."""

    def renderer(self, model: mujoco.MjModel, num: int, edge: int, alpha: float) -> Renderer:
        """Return a renderer of ``num`` environments of a model, for square pictures of ``edge`` pixels.

        The model must have a camera named ``CAMERA``. Geoms in the group ``GHOST_GROUP`` are drawn with the opacity
        ``alpha``. Raises BidexError unless the engine's attribute ``has_renderer`` is True.
        """
        raise BidexError(f"Expected an engine that draws (mujoco_warp), got {type(self).__name__}.")

    def contact_depth(self, row: int) -> float:
        """Return the deepest penetration among a simulation's contacts, metres, 0 without contact."""
        ...


EngineMaker = Callable[[Sequence[mujoco.MjModel], Sequence[int], Capacity], Engine]
"""Makes an engine from models of equal structure, the model index of each simulation, and the buffer sizes."""

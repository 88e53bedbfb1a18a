"""Gymnasium 1.x's Humanoid-v5 as a world, on ``mujoco.batch`` (paper, appendix C).

The results equal Gymnasium's bit for bit in single precision.
"""

from collections.abc import Mapping
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor

from bidex_meta.engine.cpu import CpuEngine
from bidex_meta.errors import BidexError, unknown_name
from bidex_meta.utils.validation import whole_number
from bidex_meta.world.base import Transition
from bidex_meta.world.checked import fits
from bidex_meta.world.contract import State
from bidex_meta.world.foreign_world import OWN_DRAWS, ForeignWorld, Sizes

NAME = "Humanoid-v5"
EPISODE_STEPS = 1000

_SUBSTEPS = 5
_FORWARD_WEIGHT = 1.25
_HEALTHY_REWARD = 5.0
_CONTROL_WEIGHT = 0.1
_CONTACT_WEIGHT = 5e-7
_CONTACT_MOST = 10.0
# Bounds of the torso's height, metres.
_LOWEST = 1.0
_HIGHEST = 2.0
_START_NOISE = 1e-2


class HumanoidWorld(ForeignWorld):
    """``num_envs`` humanoids that learn to walk, on the CPU: a ``contract.PooledWorld`` of one slot.

    Observations are Humanoid-v5's 348 numbers: positions without x and y, velocities, and the inertias, velocities,
    actuator forces and contact forces of the 13 bodies. Actions in [-1, 1] are scaled to the motors' range, [-0.4,
    0.4]. The reward is 1.25 times the speed of the centre of mass along x (m/s), plus 5 while the humanoid is upright,
    minus costs of control and contact. An episode terminates when the torso's height leaves 1 to 2 m, and is truncated
    after 1,000 steps of 15 ms. There is no success. Keywords are those of ``bidex_meta.World``.
    """

    def __init__(
        self,
        num_envs: int,
        *,
        seed: int = 0,
        autoreset_mode: str | AutoresetMode | None = None,
        threads: int | None = None,
        stagger: bool = True,
    ) -> None:
        file = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "humanoid.xml"
        model = mujoco.MjModel.from_xml_path(str(file))
        num_state = (model.nq - 2) + model.nv + (model.nbody - 1) * 22 + (model.nv - 6)
        super().__init__([NAME], num_envs, Sizes(num_state, model.nu, EPISODE_STEPS), seed, autoreset_mode, stagger)
        self._model = model
        self._data = mujoco.MjData(model)
        self._dt = _SUBSTEPS * model.opt.timestep
        self._mass = torch.from_numpy(model.body_mass.copy())
        self._largest = torch.from_numpy(model.actuator_ctrlrange[:, 1].copy())
        self._engine = CpuEngine([model], [0] * num_envs, threads, refresh=False)
        bind = self._engine.batch.bind
        self._bound = [torch.from_numpy(bind(name).view()) for name in ("cinert", "cvel", "qfrc_actuator")]
        self._centres = torch.from_numpy(bind("xipos").view())
        self._contact = torch.zeros(num_envs, model.nbody, 6, dtype=torch.float64)
        self._x = torch.zeros(num_envs, dtype=torch.float64)  # x of the centre of mass, metres
        self.set_tasks({NAME: np.zeros((1, 0))})

    def set_tasks(self, pools: Mapping[str, np.ndarray]) -> None:
        """Replace the pool by an array (n, 0), of which only n counts; raises BidexError for another class or shape."""
        for name, pool in pools.items():
            if name != NAME:
                raise unknown_name("class", name, [NAME])
            shape = np.shape(pool)
            if len(shape) != 2 or shape[0] == 0 or shape[1] != 0:
                raise BidexError(f"Expected tasks of {NAME} as (n, 0), because all tasks are equal, got {shape}.")
            self._set_pool_sizes([shape[0]])

    @property
    def pools(self) -> list[np.ndarray]:
        """Return the pool of tasks, an array (n, 0): tasks have no numbers, because all of them are equal."""
        return [np.zeros((self.num_slot_tasks[0], 0))]

    def _place(self, mask: Tensor) -> None:
        model = self._model
        engine = self._engine
        draws = self._draws(OWN_DRAWS + model.nq + model.nv)[mask, OWN_DRAWS:]
        noise = (2.0 * draws - 1.0) * _START_NOISE
        engine.reset(mask, torch.from_numpy(model.qpos0) + noise[:, : model.nq])
        engine.qvel[mask] = noise[:, model.nq :]
        engine.batch.forward(ids=mask.numpy())
        self._contact[mask] = 0.0
        self._x = torch.where(mask, self._centre(), self._x)
        self._obs = torch.where(mask[:, None], self._state(), self._obs)

    def _centre(self) -> Tensor:
        return (self._mass * self._centres[:, :, 0]).sum(1) / self._mass.sum()

    def _state(self) -> Tensor:
        """Return observations, (n, 348), float32."""
        inertia, velocity, force = self._bound
        parts = self._engine.qpos[:, 2:], self._engine.qvel, inertia[:, 1:], velocity[:, 1:], force[:, 6:]
        return torch.cat([part.flatten(1) for part in (*parts, self._contact[:, 1:])], dim=1).float()

    def _advance(self, active: Tensor, broken: Tensor) -> Transition:
        engine = self._engine
        moved = active & ~broken
        # Actions are in single precision, as in Gymnasium.
        engine.ctrl[:] = self._action * self._largest.float()
        engine.step(_SUBSTEPS, moved)
        self._feel(moved)
        unstable = broken | (engine.unstable() & active)
        good = moved & ~unstable
        before = self._x
        self._x = torch.where(good, self._centre(), self._x)
        contact = (_CONTACT_WEIGHT * self._contact.square().sum((1, 2))).clamp_max(_CONTACT_MOST)
        control = _CONTROL_WEIGHT * engine.ctrl.square().sum(1)
        reward = _FORWARD_WEIGHT * (self._x - before) / self._dt + _HEALTHY_REWARD * self._is_up() - control - contact
        return Transition(self._state(), reward.float(), torch.zeros_like(active), ~self._is_up(), unstable, {})

    def _is_up(self) -> Tensor:
        height = self._engine.qpos[:, 2]
        return (height > _LOWEST) & (height < _HIGHEST)

    def _feel(self, moved: Tensor) -> None:
        """Compute the external forces on all bodies, for the environments in a mask.

        MuJoCo's step does not compute these forces, but Gymnasium reads them after a step.
        """
        for row in moved.nonzero()[:, 0].tolist():
            self._engine.batch.get_data(row, self._data)
            mujoco.mj_rnePostConstraint(self._model, self._data)
            self._contact[row] = torch.from_numpy(self._data.cfrc_ext)

    def state_dict(self) -> State:
        """Return everything that decides the world's future: tensors and plain values, copied."""
        own = {"tasks": self.num_slot_tasks[0], "engine": self._engine.state_dict()}
        return {**super().state_dict(), **own, "x": self._x.clone(), "contact": self._contact.clone()}

    def load_state_dict(self, state: State) -> None:
        """Restore a ``state_dict``; raises BidexError for a state of another size."""
        fits(state, self.state_dict())
        self.set_tasks({NAME: np.zeros((whole_number("tasks", state["tasks"], 1), 0))})
        self._restore(state)
        self._engine.load_state_dict(state["engine"])
        self._x = state["x"].clone()
        self._contact = state["contact"].clone()

"""Physics engine that runs C MuJoCo on all cores of the machine, by means of ``mujoco.batch``."""
# ruff: noqa: D102 (``Engine`` says what the methods do)

import ctypes
import os
import warnings
import weakref
from collections.abc import Iterable, Sequence

import mujoco
import mujoco.batch
import numpy as np
import torch
from torch import Tensor

from bidex_meta.engine.health import LARGEST, LONGEST, SHORTEST, STATE, checked_state, outside, quaternion_columns
from bidex_meta.engine.models import differing_fields
from bidex_meta.engine.protocol import Engine
from bidex_meta.errors import BidexError
from bidex_meta.utils.memory import usable_cores

# A full arena drops contacts or constraints without an error, which is as harmful as a number out of bounds.
_TROUBLE = mujoco.mjtWarning.__members__
_BAD = [int(_TROUBLE[f"mjWARN_{n}"]) for n in ("BADQPOS", "BADQVEL", "BADQACC", "CONTACTFULL", "CNSTRFULL")]


class CpuEngine(Engine):
    """A batch of C MuJoCo simulations of models with equal structure, in double precision.

    ``Engine`` describes the tensors of the state. After each step, MuJoCo's position and velocity stages refresh the
    sensors. This costs about a tenth of the speed, but measured positions and velocities are then those of the new
    state, and a persistent batch need not repeat these stages in its next step. If ``refresh`` is False, the stages
    are left out, as in ``mj_step``: derived values are then from before the last substep.

    If any number in a simulation's state is too large, infinite or NaN, ``unstable`` reports the simulation. The
    simulation is put at rest at the model's reference pose: before a step by ``_quarantine``, and within a step by
    MuJoCo's autoreset. Without this measure, NaN would make all geoms of the simulation touch. Solving for their
    contacts would take up to thousands of times as long as a normal step, and all other simulations would wait.
    """

    device = torch.device("cpu")
    avoids_syncs = False

    def __init__(
        self, models: Sequence[mujoco.MjModel], rows: Sequence[int], threads: int | None = None, refresh: bool = True
    ) -> None:
        """Build the batch; ``rows`` gives the index of each simulation's model.

        The number of ``threads``, by default one per CPU, does not affect results.
        """
        self.num = len(rows)
        if refresh:
            self._after_step = mujoco.mjtStage.mjSTAGE_VEL
        else:
            self._after_step = mujoco.mjtStage.mjSTAGE_NONE
        # MuJoCo would print each broken row to stderr and to a log file in the working folder; unstable() reports it.
        mujoco.set_mju_user_warning(lambda message: None)
        if threads is None:
            threads = usable_cores()
        self._batch = mujoco.batch.Batch(models[0], self.num, nthread=threads, persistent=True)
        self._forked = False
        if threads > 1:
            _WITH_THREADS.add(self)
        if len(models) > 1:
            self._batch.set_models([models[i] for i in rows])
        self._state = {name: self._bind(name) for name in STATE if 0 not in self._batch.bind(name).shape}
        self.qpos, self.qvel, self.ctrl = (self._state[n] for n in ("qpos", "qvel", "ctrl"))
        self.xfrc_applied = self._state["xfrc_applied"]
        self.sensordata = self._bind("sensordata")
        self._mocap = [self._state[name] for name in ("mocap_pos", "mocap_quat") if name in self._state]
        self._failed = torch.zeros(self.num, dtype=torch.bool)
        self._numbers = torch.from_numpy(self._batch.state)
        columns = [self._column("qpos") + quaternion_columns(models[0])]
        if self._mocap:
            columns.append(self._column("mocap_quat") + np.arange(4 * models[0].nmocap))
        self._quaternions = torch.from_numpy(np.concatenate(columns))
        """Columns of ``_numbers`` that hold quaternions, four for each, shape (4 k,)."""
        self._models = list(models)
        self._model_of = list(rows)
        self._probe: mujoco.MjData | None = None
        self._poses: tuple[Tensor, Tensor] | None = None

    @property
    def batch(self) -> mujoco.batch.Batch:
        """Return the batch of simulations; raise BidexError if another process made the batch and has its threads."""
        if self._forked:
            raise BidexError(
                "Expected a world in the process that made it, got one in a forked child, which lacks the engine's "
                "threads. Make it with threads=1, or in the child."
            )
        return self._batch

    def _column(self, name: str) -> int:
        return (self._state[name].data_ptr() - self._numbers.data_ptr()) // self._numbers.element_size()

    def _bind(self, name: str) -> Tensor:
        # Torch warns that outputs of the batch are read-only; no code here writes to them.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return torch.from_numpy(self._batch.bind(name))

    def step(self, substeps: int, active: Tensor | None = None) -> None:
        self._quarantine()
        ids = None if active is None else active.numpy()
        try:
            self.batch.step(ids=ids, nstep=substeps, stage=self._after_step)
        except mujoco.batch.SimulationError as error:
            # A broken row can have more contacts than its memory holds. It keeps its old state, and the other rows are
            # stepped.
            self._failed[torch.as_tensor(error.ids)] = True

    def _quarantine(self) -> None:
        """Reset each simulation whose state has a non-finite or too large number, or a quaternion that is no rotation.

        The world may have written such a number, or the last step may have produced it.
        """
        # This avoids most operations over all rows: a row whose norm is within the smallest bound is within all bounds.
        size = torch.linalg.vector_norm(self._numbers, dim=1)
        turns = self._numbers.index_select(1, self._quaternions).unflatten(1, (-1, 4))
        lengths = torch.linalg.vector_norm(turns, dim=2)
        rotations = (lengths >= SHORTEST) & (lengths <= LONGEST)  # false where NaN
        if size.max().item() <= LARGEST and rotations.all():
            return
        broken = ~rotations.all(dim=1)
        suspects = (~(size <= LARGEST)).nonzero()[:, 0]
        broken[suspects] |= outside(self._state, suspects)
        if broken.any():
            self.batch.reset(ids=broken.numpy(), stage=mujoco.mjtStage.mjSTAGE_NONE)
            self._failed |= broken

    def unstable(self) -> Tensor:
        counts = self._batch.warning[:, :, 1]
        if counts.any():
            bad = counts.take(_BAD, axis=1).any(axis=1)
        else:
            bad = np.zeros(self.num, dtype=bool)
        # One non-finite addend makes the whole sum non-finite.
        return torch.from_numpy(bad) | self._failed | ~self.sensordata.sum(dim=1).isfinite()

    def warnings(self) -> Tensor:
        return torch.from_numpy((self._batch.warning[:, :, 1] > 0).sum(axis=1)) + self._failed

    def body_poses(self) -> tuple[Tensor, Tensor]:
        if self._poses is None:  # every bound field is copied out after every step
            self._poses = self._bind("xpos"), self._bind("xmat").unflatten(2, (3, 3))
        return self._poses

    def reset(self, mask: Tensor, start: Tensor) -> None:
        """Reset the simulations in ``mask`` to the positions in ``start``.

        If a row of ``start`` has a number out of bounds, its simulation is reset to the model's reference pose instead,
        and ``unstable`` reports the simulation.
        """
        ids = mask.numpy()
        self.batch.reset(ids=ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        start = start.to(self.qpos.dtype)
        nq = self.qpos.shape[1]
        good = (start.abs() <= LARGEST).all(dim=1)
        self._failed[mask] = ~good
        if not good.all():
            start = torch.where(good[:, None], start, self.placement()[mask])
        self.qpos[mask] = start[:, :nq]
        if self._mocap:
            position, quaternion = start[:, nq:].unflatten(1, (-1, 7)).split((3, 4), dim=2)
            self._mocap[0][mask] = position
            self._mocap[1][mask] = quaternion
        self.batch.forward(ids=ids, stage=mujoco.mjtStage.mjSTAGE_VEL)

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore a state, then refresh position and velocity sensors."""
        state = checked_state(state, self._state)
        self.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._failed[:] = False
        for name, value in state.items():
            self._state[name].copy_(value)
        self.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)

    def expand(self, names: Iterable[str]) -> dict[str, Tensor]:
        # A batch holds either several models or fields per simulation, so fields in which the models differ become
        # per-row fields.
        self.batch.set_models(None)
        differing = set[str]().union(*(differing_fields(self._models[0], model) for model in self._models))
        wanted = set(names)
        found = {}
        for name in sorted(wanted | differing & mujoco.batch.MODEL_FIELDS):
            field = self.batch.expand(name)
            field[:] = np.stack([getattr(model, name)[: field.shape[1]] for model in self._models])[self._model_of]
            if name in wanted:
                found[name] = torch.from_numpy(field).view(self.num, field.shape[1], -1)
        return found

    def model(self, row: int) -> mujoco.MjModel:
        return self._batch.get_model(row)

    def data(self, row: int) -> mujoco.MjData:
        data = self._batch.get_data(row)
        mujoco.mj_forward(self._batch.get_model(row), data)
        return data

    def contact_depth(self, row: int) -> float:
        model = self._models[self._model_of[row]]
        # Copying the batch's model and data would take forty times longer.
        data = self._probe = self._probe or mujoco.MjData(model)
        data.qpos[:] = self.qpos[row].numpy()
        if self._mocap:
            data.mocap_pos[:], data.mocap_quat[:] = (value[row].numpy() for value in self._mocap)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        if data.ncon:
            return float(max(0.0, -data.contact.dist.min()))
        return 0.0


_WITH_THREADS: "weakref.WeakSet[CpuEngine]" = weakref.WeakSet()


def _after_fork() -> None:
    """Mark the inherited batches as unusable in a child process after a fork, and keep them from being freed.

    Stepping or freeing such a batch would wait forever for threads that exist only in the parent process.
    """
    for engine in _WITH_THREADS:
        engine._forked = True
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(engine._batch))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)

"""Physics engine for accelerators: mujoco_warp, with all substeps of a control step in one captured graph.

This engine differs from C MuJoCo on purpose in four ways: single precision, sparse constraint Jacobians (mujoco_warp
refuses dense ones above 60 degrees of freedom), a solver tolerance of 1e-6 (its minimum), and contact buffers of fixed
size. Tests use the Warp CPU device.
"""
# ruff: noqa: D102 (``Engine`` says what the methods do)

import copy
import gc
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from torch import Tensor

from bidex_meta.engine import kernels
from bidex_meta.engine.capacity import Capacity, check_ordered_sums
from bidex_meta.engine.health import LARGEST, STATE, checked_state
from bidex_meta.engine.kernels import Guard
from bidex_meta.engine.lean import lean
from bidex_meta.engine.newton import fits, incremental_newton
from bidex_meta.engine.protocol import Engine
from bidex_meta.engine.renderer import BatchRenderer
from bidex_meta.engine.scratch import Scratch
from bidex_meta.errors import BidexError

# These arrays are changed by a step and used by later steps or by readers.
_STEPPED = ("time", "qpos", "qvel", "act", "history", "qacc_warmstart", "sensordata", "overflow")
# These bits mark a world whose contacts or constraints were dropped. An iteration limit is not an error, because C
# MuJoCo also stops there.
_LOST = sum(int(mjw.OverflowType[name]) for name in ("NEFC", "NJMAX_NNZ", "BROADPHASE", "NARROWPHASE", "CCD"))
# Kinematics, body velocities or the last substep give these sensors. ``_refresh`` would not update other sensors.
_SENSOR_NAMES = (
    "JOINTPOS JOINTVEL JOINTACTFRC FRAMEPOS FRAMEQUAT FRAMEXAXIS FRAMEYAXIS FRAMEZAXIS FRAMELINVEL FRAMEANGVEL "
    "FORCE TORQUE TOUCH"
)
_SENSORS = [int(mujoco.mjtSensor.__members__[f"mjSENS_{name}"]) for name in _SENSOR_NAMES.split()]


class WarpEngine(Engine):
    """A batch of mujoco_warp simulations of models with equal structure, in single precision.

    ``Engine`` describes the tensors of the state. ``step`` and ``reset`` replay recorded graphs and never wait for the
    device. Graphs hold pointers, so write into arrays in place, and call ``recapture`` after any other change of the
    model. On a CUDA device, graphs run on the engine's own stream. They start after all work that was queued on torch's
    current stream before the call, and later work on that stream waits for them.

    If any number in a world's state is too large, infinite or NaN, ``unstable`` reports the world, and the world is
    kept at the model's reference pose until its reset. Without this measure, its NaNs would pass every broadphase test
    and fill the buffers that other worlds' contacts need.
    """

    avoids_syncs = True
    has_renderer = True

    def __init__(
        self, models: Sequence[mujoco.MjModel], rows: Sequence[int], capacity: Capacity,
        device: str | torch.device = "cpu", deterministic: bool = False, incremental: bool = False
    ) -> None:  # fmt: skip
        """Put the models on the device and compile the kernels; ``rows`` gives the index of each simulation's model.

        ``deterministic`` orders contacts, constraints and sums, so that simulations on a GPU are reproducible bit for
        bit. ``incremental`` lets the solver update the Hessian of elliptic cones between iterations (``newton.py``).
        """
        if deterministic and incremental:
            raise BidexError("incremental: expected it without deterministic, got both. Leave one of them out.")
        self._deterministic = deterministic
        self._incremental = incremental
        wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)  # prints no banner and no line per kernel
        self.num = len(rows)
        self.device = torch.device(device)
        self._models = list(models)
        self._rows = list(rows)
        self._device = wp.get_device(str(self.device))
        # torch must create the stream: torch's default, CUDA's legacy stream, waits for streams that Warp creates.
        priority = -1 if _is_slow(models[0]) else 0
        if self._device.is_cuda:
            self._lent = torch.cuda.Stream(self.device, priority=priority)
        else:
            self._lent = None
        if self._lent is not None:
            self._stream = wp.stream_from_torch(self._lent)
        else:
            self._stream = None
        self._graphs: dict[str, Callable[[], None]] = {}
        with self._on_device():
            self._put(capacity)
            self._bind()
            self._substeps = 1
            self._check_sums()
            self._scratch = Scratch(self._device)
            with self._from_scratch():
                self._advance()  # compiles all kernels and allocates memory, which a capture cannot do
                self._begin()
        self._mask_view.fill_(True)
        with self._on_device():
            mjw.reset_data(self._m, self._d, reset=self._mask)
            self._guard.keep(self._d)
        self._failed_view.zero_()

    def _put(self, capacity: Capacity) -> None:
        kinds = {mujoco.mjtSensor(kind).name for kind in self._models[0].sensor_type if kind not in _SENSORS}
        if kinds:
            raise BidexError(f"Expected sensors among {_SENSOR_NAMES}, got {', '.join(sorted(kinds))}.")
        self._m = _put_models([_adapted(model) for model in self._models], self._rows)
        if self._deterministic:
            self._m.opt.deterministic = mjw.DeterminismType.ALL
        self._m.opt.warn_overflow = 0  # unstable() reports overflows; printing from kernels is slow
        # With C MuJoCo's 1e-6, the normals of an egg's contacts differed from C by 5e-3 rad (99th percentile); with
        # this value by 1.5e-3 rad. With 1e-10 some contacts were lost.
        self._m.opt.ccd_tolerance.fill_(1e-8)
        self._m.opt.graph_conditional = not self._device.is_cuda or wp.is_conditional_graph_supported()
        self._lean = lean(self._m)
        room = {"nconmax": capacity.contacts, "nccdmax": capacity.convex, "njmax": capacity.rows}
        d = self._d = mjw.make_data(_adapted(self._models[0]), nworld=self.num, **room)
        _put_static_frames(d, self._models, self._rows)
        self._guard = Guard(self._models[0], d)
        self._mask = wp.zeros(self.num, dtype=bool)
        self._start = wp.zeros((self.num, d.qpos.shape[1] + 7 * d.mocap_pos.shape[1]), dtype=float)

    def _bind(self) -> None:
        arrays = {name: vars(self._d)[name] for name in {*STATE, *_STEPPED}}
        views = {name: wp.to_torch(array) for name, array in arrays.items() if 0 not in array.shape}
        self._state = {name: views[name] for name in STATE if name in views}
        self.qpos, self.qvel, self.ctrl = (views[name] for name in ("qpos", "qvel", "ctrl"))
        self.xfrc_applied = views["xfrc_applied"]
        self.sensordata = views["sensordata"]
        self._overflow = views["overflow"]
        self._failed_view = wp.to_torch(self._guard.failed)
        self._stepped = [views[name] for name in _STEPPED if name in views] + [self._failed_view]
        self._poses: tuple[Tensor, ...] = ()
        self._mocap = [views[name] for name in ("mocap_pos", "mocap_quat") if name in views]
        self._mask_view = wp.to_torch(self._mask)
        self._start_view = wp.to_torch(self._start)

    def step(self, substeps: int, active: Tensor | None = None) -> None:
        """Step all simulations; simulations outside the mask take the same time but keep their state."""
        stepped: list[Tensor] = []
        kept: list[Tensor] = []
        if active is not None:
            stepped = [*self._stepped, *self._poses]
            kept = [value.clone() for value in stepped]
        self._substeps = substeps
        name = f"step {substeps}"
        if name not in self._graphs:
            self._check_sums()
        self._play(name, self._advance)
        if active is not None:
            for value, old in zip(stepped, kept, strict=True):
                value.copy_(torch.where(active.view(-1, *[1] * (value.dim() - 1)), value, old))

    def unstable(self) -> Tensor:
        """Return which worlds broke since their reset, bool (num,).

        If the contact buffer, which all worlds share, is full, all worlds count as broken, because any of them may have
        lost contacts.
        """
        lost = (self._overflow & _LOST) != 0
        return lost | self._failed_view | ~self.sensordata.sum(dim=1).isfinite()

    def warnings(self) -> Tensor:
        return self.unstable().long()

    def body_poses(self) -> tuple[Tensor, Tensor]:
        poses = wp.to_torch(self._d.xpos), wp.to_torch(self._d.xmat)
        self._poses = poses  # from now on they also stay where a simulation does not step
        return poses

    def reset(self, mask: Tensor, start: Tensor) -> None:
        """Reset simulations; a start with a non-finite number makes its simulation unstable.

        The reset refreshes position and velocity sensors of all simulations. That changes only simulations whose state
        was written by hand since their last step.
        """
        self._mask_view.copy_(mask)
        self._start_view.copy_(start)
        self._play("reset", self._begin)

    def recapture(self) -> None:
        """Discard the graphs; the next calls record new ones."""
        self._graphs.clear()
        with self._on_device():
            self._lean = lean(self._m)

    def expand(self, names: Iterable[str]) -> dict[str, Tensor]:
        found = {}
        with self._on_device():
            for name in names:
                field = getattr(self._m, name, None)
                if field is None:  # mujoco_warp has no bounding volumes
                    continue
                if len(field) != self.num:
                    field = wp.array(np.repeat(field.numpy(), self.num, axis=0), dtype=field.dtype)
                    setattr(self._m, name, field)
                found[name] = wp.to_torch(field).view(self.num, field.shape[1], -1)
        self.recapture()
        return found

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore a state that this engine or ``CpuEngine`` saved, and refresh position and velocity sensors."""
        state = checked_state(state, self._state)
        self._mask_view.fill_(True)
        self._play("reset", self._begin)
        self._failed_view.zero_()
        for name, value in state.items():
            self._state[name].copy_(value)
        self._play("refresh", self._refresh)

    def model(self, row: int) -> mujoco.MjModel:
        return self._models[self._rows[row]]

    def data(self, row: int) -> mujoco.MjData:
        model = self.model(row)
        data = mujoco.MjData(model)
        data.time = float(self._state["time"][row])
        for name in self._state.keys() - {"time"}:
            target = getattr(data, name)
            target[...] = self._state[name][row].cpu().numpy().reshape(target.shape)
        mujoco.mj_forward(model, data)
        return data

    def renderer(self, model: mujoco.MjModel, num: int, edge: int, alpha: float) -> BatchRenderer:
        return BatchRenderer(_adapted(model), num, edge, alpha, self._on_device)

    def contact_depth(self, row: int) -> float:
        distances = self.data(row).contact.dist
        if len(distances):
            return float(max(0.0, -np.min(distances)))
        return 0.0

    def demand(self) -> tuple[int, int]:
        """Return two counts over all worlds in their present state, which help to choose buffer sizes.

        The first counts the pairs of geoms that the broadphase passes on. The second counts the contacts of ellipsoids
        and cylinders that the convex collider computes.
        """
        self._play("position", lambda: mjw.fwd_position(self._m, self._d, factorize=False))
        d = self._d
        candidates, contacts, geoms = (wp.to_torch(x).cpu() for x in (d.ncollision, d.nacon, d.contact.geom))
        kinds = self._models[0].geom_type[geoms[: int(contacts[0])].numpy()]
        round_ones = (mujoco.mjtGeom.mjGEOM_ELLIPSOID, mujoco.mjtGeom.mjGEOM_CYLINDER)
        convex = np.isin(kinds, round_ones).any(axis=1) & (kinds != mujoco.mjtGeom.mjGEOM_PLANE).all(axis=1)
        return int(candidates[0]), int(convex.sum())

    def _check_sums(self) -> None:
        """Raise BidexError if the ordered sums of the next graph would not fit into the GPU's free memory."""
        if self._deterministic and self._device.is_cuda:
            check_ordered_sums(self._m.nv, self._d.njmax, self.num, self._substeps, self._device.free_memory)

    def _advance(self) -> None:
        """Run the substeps of a control step, then refresh position and velocity sensors."""
        m = self._m
        d = self._d
        self._guard.examine(d)
        with incremental_newton() if self._incremental and fits(m) else nullcontext():
            for left in reversed(range(self._substeps)):
                self._guard.watch(m, d)
                self._lean.step(d, last=not left)
        self._guard.watch(m, d)
        self._refresh()

    def _refresh(self) -> None:
        """Compute position and velocity sensors of the present state; force sensors do not change."""
        m = self._lean.refresh
        d = self._d
        mjw.fwd_kinematics(m, d)
        mjw.com_vel(m, d)
        mjw.sensor_pos(m, d)
        mjw.sensor_vel(m, d)

    def _begin(self) -> None:
        d = self._d
        mjw.reset_data(self._m, d, reset=self._mask)
        inputs = [self._mask, self._start, LARGEST]
        outputs = [d.qpos, d.mocap_pos, d.mocap_quat, self._guard.failed]
        wp.launch(kernels.place, dim=self.num, inputs=inputs, outputs=outputs, device=self._device)
        self._refresh()

    def _play(self, name: str, work: Callable[[], None]) -> None:
        """Run ``work`` as a recorded graph on the engine's stream, after torch's earlier and before its later work.

        The graph is recorded at the first call and stored under ``name``.
        """
        with self._on_device():
            if name not in self._graphs:
                self._graphs[name] = self._record(work)
            self._graphs[name]()

    def _record(self, work: Callable[[], None]) -> Callable[[], None]:
        if self._device.is_cuda and not wp.is_mempool_enabled(self._device):
            warnings.warn(
                f"Expected a memory pool on {self._device}, which graphs need to allocate, found none; every kernel is "
                "launched from Python instead, about ten times slower.",
                stacklevel=2,
            )
            return work
        scoped = wp.ScopedCapture(device=self._device, stream=self._stream)
        with _no_garbage_collection(), self._from_scratch(), scoped as capture:
            work()
        graph = capture.graph
        assert graph is not None
        return lambda: wp.capture_launch(graph, stream=self._stream)

    def _from_scratch(self) -> AbstractContextManager[object]:
        """Make Warp allocate from the engine's scratch memory; on the CPU Warp's allocator cannot be replaced."""
        if self._device.is_cuda:
            return wp.ScopedAllocator(self._device, self._scratch)
        return nullcontext()

    @contextmanager
    def _on_device(self) -> Iterator[None]:
        """Run Warp on the engine's stream.

        The engine's stream first waits for torch's stream. Afterwards torch's stream waits for the engine's stream.
        """
        if self._lent is None:
            with wp.ScopedDevice(self._device):
                yield
            return
        theirs = torch.cuda.current_stream(self.device)
        self._lent.wait_stream(theirs)
        with wp.ScopedStream(self._stream, sync_enter=False):
            yield
        theirs.wait_stream(self._lent)


@contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Pause garbage collection: a graph collected during a capture would record its own destruction."""
    finish = gc.enable if gc.isenabled() else gc.disable
    gc.disable()
    try:
        yield
    finally:
        finish()


def _adapted(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy of a model with the options that give the same physics in mujoco_warp."""
    model = copy.copy(model)
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    # C MuJoCo has a separate routine for two boxes with up to eight contacts. mujoco_warp uses such a routine only with
    # this flag, which has no other effect there; otherwise boxes go through the convex collider, which gives four
    # contacts.
    model.opt.disableflags |= int(mjw.DisableBit.NATIVECCD)
    model.opt.disableflags &= ~int(
        mujoco.mjtDisableBit.mjDSBL_AUTORESET
    )  # mujoco_warp has no autoreset and refuses the flag
    return model


def _is_slow(model: mujoco.MjModel) -> bool:
    """Return whether simulations of a model are slow, so that their engine's stream should have a high priority.

    They are slow with many substeps, or with kernels that have only one thread per matrix (implicit integrator).
    When slow simulations get the GPU first, a step of MT20 with 8,192 environments takes 38.6 instead of 42.3 ms.
    """
    return model.opt.timestep < 1.0 / 200.0 or model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICIT


def _put_models(models: Sequence[mujoco.MjModel], rows: Sequence[int]) -> mjw.Model:
    """Return one model on the device; fields in which the given models differ are per world."""
    singles = [mjw.put_model(model) for model in models]
    differing: dict[str, list[np.ndarray]] = {}
    for name, field in vars(singles[0]).items():
        if isinstance(field, wp.array):
            values = [vars(single)[name].numpy() for single in singles]
            if any(not np.array_equal(values[0], other, equal_nan=True) for other in values[1:]):
                differing[name] = values
    if not differing:
        return singles[0]
    model = mjw.put_model(models[0], batch_sizes=dict.fromkeys(differing, len(rows)))
    for name, values in differing.items():
        vars(model)[name].assign(np.concatenate(values)[rows])
    return model


def _put_static_frames(data: mjw.Data, models: Sequence[mujoco.MjModel], rows: Sequence[int]) -> None:
    """Write the frames of static geoms, which no step computes, into each world, from the world's own model."""
    frames = [mujoco.MjData(model) for model in models]
    for model, one in zip(models, frames, strict=True):
        mujoco.mj_kinematics(model, one)
    for name in ("xquat", "xmat", "ximat", "geom_xpos", "geom_xmat"):
        array = vars(data)[name]
        array.assign(np.stack([getattr(x, name) for x in frames])[rows].reshape(array.numpy().shape))

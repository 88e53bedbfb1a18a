"""Warp kernels that detect and reset broken simulations, write start states, and compensate gravity.

Each thread handles one simulated world or one number of a world. Warp's ``and`` evaluates both sides, so an index is
checked in an outer ``if`` before an inner ``if`` uses it.
"""
# pyright: reportIndexIssue=false, reportAttributeAccessIssue=false, reportOperatorIssue=false
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportArgumentType=false, reportCallIssue=false
# ruff: noqa: SIM102, UP018

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from bidex_meta.engine.health import LARGEST, LONGEST, SHORTEST, quaternion_columns

# The first index of these arrays is the world; some have a second index for a number within the world.
Flags = wp.array[bool]
Times = wp.array[float]
Numbers = wp.array2d[float]
Points = wp.array2d[wp.vec3]
Turns = wp.array2d[wp.quat]
Wrenches = wp.array2d[wp.spatial_vector]


@wp.kernel(enable_backward=False)
def watch(qpos: Numbers, qvel: Numbers, qacc: Numbers, limit: float, limit_of_qacc: float, failed: Flags):
    """Set ``failed`` for each world with a position, velocity or acceleration that is NaN or beyond its limit.

    The conditions are negated, because a comparison with NaN is false.
    """
    world, i = wp.tid()
    if not (wp.abs(qpos[world, i]) <= limit):
        failed[world] = True
    if i < qvel.shape[1]:
        if not (wp.abs(qvel[world, i]) <= limit and wp.abs(qacc[world, i]) <= limit_of_qacc):
            failed[world] = True


@wp.kernel(enable_backward=False)
def examine(
    time: Times, warmstart: Numbers, ctrl: Numbers, qfrc_applied: Numbers, xfrc_applied: Wrenches, limit: float,
    failed: Flags
):  # fmt: skip
    """Mark worlds whose time, controls, forces or warm start are NaN or beyond the limit."""
    world, i = wp.tid()
    if not (wp.abs(time[world]) <= limit):
        failed[world] = True
    if i < warmstart.shape[1]:
        if not (wp.abs(warmstart[world, i]) <= limit and wp.abs(qfrc_applied[world, i]) <= limit):
            failed[world] = True
    if i < ctrl.shape[1]:
        if not (wp.abs(ctrl[world, i]) <= limit):
            failed[world] = True
    if i < xfrc_applied.shape[1]:
        for k in range(6):
            if not (wp.abs(xfrc_applied[world, i][k]) <= limit):
                failed[world] = True


@wp.kernel(enable_backward=False)
def examine_poses(
    qpos: Numbers, quaternions: wp.array[int], mocap_pos: Points, mocap_quat: Turns, limit: float, shortest: float,
    longest: float, failed: Flags
):  # fmt: skip
    """Set ``failed`` for each world with an invalid quaternion, or with a mocap body out of bounds.

    A quaternion is invalid if its length is not between ``shortest`` and ``longest``. ``quaternions`` holds the index
    of the first of the four entries that each quaternion has in ``qpos``.
    """
    world, i = wp.tid()
    if i < quaternions.shape[0]:
        k = quaternions[i]
        q = wp.vec4(qpos[world, k], qpos[world, k + 1], qpos[world, k + 2], qpos[world, k + 3])
        if not (wp.length(q) >= shortest and wp.length(q) <= longest):
            failed[world] = True
    if i < mocap_pos.shape[1]:
        turn = wp.length(mocap_quat[world, i])
        if not (wp.length(mocap_pos[world, i]) <= limit and turn >= shortest and turn <= longest):
            failed[world] = True


@wp.kernel(enable_backward=False)
def quarantine(failed: Flags, qpos0: Numbers, qpos: Numbers, qvel: Numbers, warmstart: Numbers):
    """Put failed worlds at rest at the reference pose."""
    world, i = wp.tid()
    if failed[world]:
        qpos[world, i] = qpos0[world % qpos0.shape[0], i]
        if i < qvel.shape[1]:
            qvel[world, i] = 0.0
            warmstart[world, i] = 0.0


@wp.kernel(enable_backward=False)
def disarm(
    failed: Flags, mocap_pos0: Points, mocap_quat0: Turns, time: Times, ctrl: Numbers, qfrc_applied: Numbers,
    xfrc_applied: Wrenches, mocap_pos: Points, mocap_quat: Turns
):  # fmt: skip
    """Set time, controls and forces of failed worlds to zero, and put their mocap bodies back to the stored poses."""
    world, i = wp.tid()
    if not failed[world]:
        return
    time[world] = 0.0
    if i < ctrl.shape[1]:
        ctrl[world, i] = 0.0
    if i < qfrc_applied.shape[1]:
        qfrc_applied[world, i] = 0.0
    if i < xfrc_applied.shape[1]:
        xfrc_applied[world, i] = wp.spatial_vector(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if i < mocap_pos.shape[1]:
        mocap_pos[world, i] = mocap_pos0[world, i]
        mocap_quat[world, i] = mocap_quat0[world, i]


@wp.kernel(enable_backward=False)
def place(
    mask: Flags, start: Numbers, limit: float, qpos: Numbers, mocap_pos: Points, mocap_quat: Turns, failed: Flags
):
    """Write a start state into each world whose mask entry is true.

    A row of ``start`` holds ``qpos``, then the position and quaternion of each mocap body. A row with a number that is
    NaN or beyond the limit is not written: its world stays at the reference pose, and ``failed`` is set.
    """
    world = wp.tid()
    if not mask[world]:
        return
    bad = bool(False)
    for i in range(start.shape[1]):
        bad = bad or not (wp.abs(start[world, i]) <= limit)
    failed[world] = bad
    if bad:
        return
    nq = qpos.shape[1]
    for i in range(nq):
        qpos[world, i] = start[world, i]
    for i in range(mocap_pos.shape[1]):
        k = nq + 7 * i
        mocap_pos[world, i] = wp.vec3(start[world, k], start[world, k + 1], start[world, k + 2])
        # Four numbers in MuJoCo's order, w first; Warp names them differently.
        mocap_quat[world, i] = wp.quat(
            start[world, k + 3], start[world, k + 4], start[world, k + 5], start[world, k + 6]
        )


@wp.kernel(enable_backward=False)
def carry(
    gravity: wp.array[wp.vec3], root: wp.array[int], mass: Numbers, share: Numbers, moved: wp.array2d[int],
    bodies: wp.array[int], xipos: Points, subtree_com: Points, cdof: Wrenches, qfrc_passive: Numbers
):  # fmt: skip
    """Add to the passive forces ``qfrc_passive`` the gravity compensation of the given bodies.

    ``share`` is the fraction of its weight for which each body is compensated (MuJoCo's ``gravcomp``).
    """
    world, dof = wp.tid()
    force = float(0.0)
    for i in range(bodies.shape[0]):
        body = bodies[i]
        if moved[body, dof] != 0:
            lift = -gravity[world % gravity.shape[0]] * mass[world % mass.shape[0], body]
            lift = lift * share[world % share.shape[0], body]
            arm = xipos[world, body] - subtree_com[world, root[body]]
            axis = cdof[world, dof]
            force += wp.dot(wp.spatial_bottom(axis) + wp.cross(wp.spatial_top(axis), arm), lift)
    qfrc_passive[world, dof] += force


class Guard:
    """Finds worlds whose state has a non-finite or too large number, and resets them to the model's reference pose.

    All methods only launch kernels; none waits for the device.
    """

    def __init__(self, model: mujoco.MjModel, data: mjw.Data) -> None:
        """Allocate the arrays on the current device. Call ``keep`` before the first step."""
        self.failed = wp.zeros(data.nworld, dtype=bool)
        """True for worlds that broke since their last reset, shape (num,), bool."""
        self._quaternions = wp.array(quaternion_columns(model)[::4].astype(np.int32), dtype=int)
        self._fixtures = [wp.clone(data.mocap_pos), wp.clone(data.mocap_quat)]

    def _launch(self, kernel: wp.Kernel, dim: tuple[int, ...], inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.failed.device)

    def keep(self, data: mjw.Data) -> None:
        """Store the present poses of all mocap bodies; ``examine`` restores these poses in broken worlds."""
        for kept, now in zip(self._fixtures, (data.mocap_pos, data.mocap_quat), strict=True):
            wp.copy(kept, now)

    def examine(self, d: mjw.Data) -> None:
        """Mark worlds whose time, controls, applied forces, warm start or poses are NaN or out of bounds.

        This runs before each control step, because callers write these fields and no substep checks them. In all marked
        worlds, time, controls and forces are set to zero, and mocap bodies return to the poses stored by ``keep``.
        """
        applied = [d.ctrl, d.qfrc_applied, d.xfrc_applied]
        width = max(array.shape[1] for array in applied)
        fixtures = d.mocap_pos.shape[1]
        limit = float(mujoco.mjMAXVAL)
        self._launch(examine, (d.nworld, width), [d.time, d.qacc_warmstart, *applied, limit], [self.failed])
        poses = [d.qpos, self._quaternions, d.mocap_pos, d.mocap_quat, LARGEST, SHORTEST, LONGEST]
        self._launch(examine_poses, (d.nworld, max(self._quaternions.shape[0], fixtures)), poses, [self.failed])
        outputs = [d.time, *applied, d.mocap_pos, d.mocap_quat]
        self._launch(disarm, (d.nworld, max(width, fixtures)), [self.failed, *self._fixtures], outputs)

    def watch(self, m: mjw.Model, d: mjw.Data) -> None:
        """Mark worlds with a bad number, as mj_checkPos, mj_checkVel and mj_checkAcc do.

        Marked worlds are put at rest at the reference pose.
        """
        self._launch(watch, d.qpos.shape, [d.qpos, d.qvel, d.qacc, LARGEST, float(mujoco.mjMAXVAL)], [self.failed])
        self._launch(quarantine, d.qpos.shape, [self.failed, m.qpos0], [d.qpos, d.qvel, d.qacc_warmstart])

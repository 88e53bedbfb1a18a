"""Variant of mujoco_warp's Newton solver that updates the Hessian incrementally for elliptic friction cones too.

For pyramidal cones, mujoco_warp updates the Hessian between iterations: it adds the constraint rows that enter the
quadratic zone and removes those that leave it. It skips gradient, Hessian and factorisation of worlds in which nothing
changed. For elliptic cones mujoco_warp rebuilds everything in every iteration, because the Hessian of a contact in the
cone zone always changes.

This module keeps a base Hessian without the contacts in the cone zone, and updates it as mujoco_warp does for pyramids.
The contacts in the cone zone are added to a copy, which is factorised in place. A world without such contacts is
treated like a world with pyramidal cones. An iteration takes seven kernels. Results agree with mujoco_warp's within the
solver's tolerance.
"""
# ruff: noqa: RUF046, UP018  (Warp makes constants of plain literals)
# pyright: reportIndexIssue=false, reportAttributeAccessIssue=false, reportOperatorIssue=false
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportArgumentType=false, reportCallIssue=false

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import mujoco_warp as mjw
import warp as wp
from mujoco_warp._src import solver
from mujoco_warp._src.types import TILE_SIZE_JTDAJ_DENSE, ConstraintState, vec5

from bidex_meta.engine.lu import wait

_LANES = 64
_CONE = int(ConstraintState.CONE)
_QUADRATIC = int(ConstraintState.QUADRATIC)
_LIMIT_REACHED = int(mjw.OverflowType.ITERATIONS)
_SMALLEST = 1e-15  # MuJoCo's bound of a divisor
# Between these degrees of freedom mujoco_warp factorises in blocks without looking for empty ones.
_LEAST = 32
_MOST = 96

Flags = wp.array[bool]
Counts = wp.array[int]
Scalars = wp.array[float]
Indices = wp.array2d[int]
Numbers = wp.array2d[float]
Columns = wp.array3d[int]
Matrices = wp.array3d[float]


def fits(m: mjw.Model) -> bool:
    """Return whether this module can solve a model: Newton solver, sparse Jacobian, and 33 to 96 degrees of freedom.

    The number of degrees of freedom must also be smaller than its padded value ``nv_pad``.
    """
    return m.opt.solver == mjw.SolverType.NEWTON and m.is_sparse and _LEAST < m.nv <= _MOST and m.nv < m.nv_pad


@contextmanager
def incremental_newton() -> Iterator[None]:
    """Make mujoco_warp use this module's solver iteration within the ``with`` block.

    Launch or record kernels in the block only for models for which ``fits`` returns True.
    """
    ours = {
        "_use_incremental": lambda m: True,
        "_solver_iteration": _solver_iteration,
        "_update_gradient": _first_gradient,
        "_cholesky_factorize_solve": _first_direction,
    }
    theirs = {name: getattr(solver, name) for name in ours}
    try:
        for name, function in ours.items():
            setattr(solver, name, function)
        yield
    finally:
        for name, function in theirs.items():
            setattr(solver, name, function)


_update_gradient = solver._update_gradient


def _first_gradient(m: mjw.Model, d: mjw.Data, ctx: Any, compact: bool = False) -> None:
    """Compute the gradient, the base Hessian (without contacts in the cone zone) and the first search direction."""
    # mujoco_warp's kernel for pyramids leaves out rows in the cone zone.
    _update_gradient(replace(m, opt=replace(m.opt, cone=mjw.ConeType.PYRAMIDAL)), d, ctx, compact)


def _first_direction(m: mjw.Model, d: mjw.Data, ctx: Any) -> None:
    """Add the contacts in the cone zone to the Hessian, factorise it, and compute the first search direction."""
    ctx.cones = wp.empty(d.nworld, dtype=int)
    outputs = [ctx.hfactor, ctx.quad_changed_count, ctx.state_changed_count, ctx.cones]
    _per_world(_begin, d, [ctx.done, *_contacts(m, d, ctx), ctx.h], outputs)
    kernel = solver._update_gradient_cholesky_blocked(TILE_SIZE_JTDAJ_DENSE, m.nv_pad, m.nv)
    _factorise(kernel, m, d, ctx, [ctx.hfactor])


def _solver_iteration(m: mjw.Model, d: mjw.Data, ctx: Any, nsolving: wp.array, compact: bool = False) -> None:
    """Take a Newton step in all worlds that have not converged, and compute the direction of the next step."""
    solver._linesearch(m, d, ctx)
    efc = d.efc
    contact = d.contact
    zones = [m.opt.impratio_invsqrt, d.ne, d.nf, d.nefc, contact.friction, contact.dim, contact.efc_address]
    zones += [efc.type, efc.id, efc.D, efc.frictionloss, d.nacon, ctx.Jaref, ctx.ls_exhausted, ctx.done]
    changes = [ctx.quad_changed_ids, ctx.quad_changed_count, ctx.state_changed_count]
    kernel = solver._update_constraint_efc(True, False)
    wp.launch(kernel, dim=(d.nworld, d.njmax), inputs=zones, outputs=[efc.force, efc.state, *changes])
    inputs = [m.nv, d.nefc, d.qfrc_smooth, efc.Ma, efc.force, ctx.alpha, *changes, ctx.done, *_contacts(m, d, ctx)]
    outputs = [ctx.h, ctx.hfactor, ctx.grad, ctx.grad_dot, ctx.newton_decrement, ctx.grad_scale]
    _per_world(_prepare, d, inputs, [*outputs, ctx.search_unchanged, ctx.cones])
    kernel = solver._update_gradient_cholesky_blocked_skip_unchanged(TILE_SIZE_JTDAJ_DENSE, m.nv_pad, m.nv, True)
    changed = ctx.state_changed_count
    _factorise(kernel, m, d, ctx, [ctx.hfactor, changed, changed])
    inputs = [m.opt.tolerance, m.opt.iterations, ctx.inertia_scale, ctx.grad_dot, ctx.newton_decrement]
    inputs += [ctx.improvement, ctx.alpha, ctx.cones]
    outputs = [d.solver_niter, d.overflow, nsolving, ctx.done, ctx.search_unchanged, *changes[1:]]
    wp.launch(_finish, dim=d.nworld, inputs=inputs, outputs=outputs)


def _contacts(m: mjw.Model, d: mjw.Data, ctx: Any) -> list[wp.array]:
    """Return the contact and constraint arrays from which the kernels compute the Hessian, in the kernels' order."""
    efc = d.efc
    blocks = [efc.jtdaj_adr, efc.jtdaj_nrow, efc.jtdaj_nblock, efc.J_rownnz, efc.J_rowadr, efc.J_colind, efc.J]
    return [m.opt.impratio_invsqrt, d.contact.friction, d.contact.dim, efc.id, *blocks, efc.D, efc.state, ctx.Jaref]


def _per_world(kernel: wp.Kernel, d: mjw.Data, inputs: list, outputs: list) -> None:
    """Launch a kernel with one block of threads per world (one thread per world on the CPU)."""
    device = d.qpos.device
    lanes = _LANES if device.is_cuda else 1
    wp.launch(kernel, dim=(d.nworld, lanes), inputs=[lanes, *inputs], outputs=outputs, block_dim=lanes, device=device)


def _factorise(kernel: wp.Kernel, m: mjw.Model, d: mjw.Data, ctx: Any, inputs: list) -> None:
    """Factorise the Hessian in place and solve for the direction."""
    gradient = ctx.grad.reshape((d.nworld, ctx.grad.shape[1], 1))
    search = ctx.search.reshape((d.nworld, m.nv, 1))
    wp.launch_tiled(
        kernel,
        dim=d.nworld,
        inputs=[ctx.done, gradient, *inputs, ctx.hfactor],
        outputs=[search, ctx.search_dot, ctx.newton_decrement],
        block_dim=m.block_dim.update_gradient_cholesky_blocked,
    )


@wp.func
def _entry(number: int) -> wp.vec2i:
    """Return row and column of an entry of an upper triangle, counted column by column."""
    column = int((wp.sqrt(float(8 * number + 1)) - 1.0) * 0.5)
    return wp.vec2i(number - column * (column + 1) // 2, column)


@wp.func
def _with_cones(
    world: int, lane: int, lanes: int, impratio_invsqrt: Scalars, friction: wp.array[vec5], dim: Counts,
    contact: Indices, head: Indices, height: Indices, blocks: Counts, support: Indices, first: Indices,
    columns: Columns, jacobian: Matrices, weight: Numbers, zone: Indices, residual: Numbers, base: Matrices,
    hessian: Matrices
) -> int:  # fmt: skip
    """Write the upper triangle of a world's Hessian: ``base`` plus the terms of the contacts in the cone zone.

    Returns the number of contacts in the cone zone.
    """
    n = base.shape[1]
    for i in range(n):
        for j in range(i + lane, n, lanes):
            hessian[world, i, j] = base[world, i, j]
    wait()
    cones = int(0)
    for block in range(blocks[world]):
        row = head[world, block]
        if zone[world, row] == wp.static(_CONE):
            cones += 1
            k = contact[world, row]
            rub = friction[k]
            mu = rub[0] * impratio_invsqrt[world % impratio_invsqrt.shape[0]]
            last = wp.min(dim[k], height[world, block])
            normal = mu * residual[world, row]
            square = float(0.0)
            for r in range(1, last):
                slip = rub[r - 1] * residual[world, row + r]
                square += slip * slip
            tangent = wp.max(wp.sqrt(square), wp.static(_SMALLEST))
            # The cost is half of ``stiffness`` times the square of (normal - mu tangent).
            scale = mu * mu * (1.0 + mu * mu)
            stiffness = float(0.0)
            if scale > 0.0:
                stiffness = weight[world, row] / scale
            bend = mu * mu - mu * normal / tangent
            width = support[world, row]
            for entry in range(lane, width * (width + 1) // 2, lanes):
                place = _entry(entry)
                at = first[world, row]
                ahead_a = mu * jacobian[world, 0, at + place[0]]
                ahead_b = mu * jacobian[world, 0, at + place[1]]
                i = columns[world, 0, at + place[0]]
                j = columns[world, 0, at + place[1]]
                along_a = float(0.0)
                along_b = float(0.0)
                across = float(0.0)
                for r in range(1, last):
                    at = first[world, row + r]
                    slip = rub[r - 1] * residual[world, row + r] / tangent
                    step_a = rub[r - 1] * jacobian[world, 0, at + place[0]]
                    step_b = rub[r - 1] * jacobian[world, 0, at + place[1]]
                    along_a += slip * step_a
                    along_b += slip * step_b
                    across += step_a * step_b
                value = (ahead_a - mu * along_a) * (ahead_b - mu * along_b) + bend * (across - along_a * along_b)
                upper = wp.min(i, j)
                right = wp.max(i, j)
                hessian[world, upper, right] = hessian[world, upper, right] + stiffness * value
            wait()
    return cones


@wp.kernel(enable_backward=False)
def _begin(
    lanes: int, done: Flags, impratio_invsqrt: Scalars, friction: wp.array[vec5], dim: Counts, contact: Indices,
    head: Indices, height: Indices, blocks: Counts, support: Indices, first: Indices, columns: Columns,
    jacobian: Matrices, weight: Numbers, zone: Indices, residual: Numbers, base: Matrices, hessian: Matrices,
    rows_changed: Counts, changed: Counts, cones: Counts
):  # fmt: skip
    """Add the contacts in the cone zone to the first Hessian of each world, and initialise the counters of changes.

    The counter of changed states starts at the number of these contacts, because their Hessian always changes.
    """
    world, lane = wp.tid()
    if done[world]:
        return
    found = _with_cones(
        world, lane, lanes, impratio_invsqrt, friction, dim, contact, head, height, blocks, support, first, columns,
        jacobian, weight, zone, residual, base, hessian
    )  # fmt: skip
    if lane == 0:
        cones[world] = found
        changed[world] = found
        rows_changed[world] = 0


@wp.kernel(enable_backward=False)
def _prepare(
    lanes: int, nv: int, rows: Counts, smooth: Numbers, inertial: Numbers, force: Numbers, alpha: Scalars,
    changed_rows: Indices, rows_changed: Counts, changed: Counts, done: Flags, impratio_invsqrt: Scalars,
    friction: wp.array[vec5], dim: Counts, contact: Indices, head: Indices, height: Indices, blocks: Counts,
    support: Indices, first: Indices, columns: Columns, jacobian: Matrices, weight: Numbers, zone: Indices,
    residual: Numbers, base: Matrices, hessian: Matrices, gradient: Numbers, gradient_square: Scalars,
    decrement: Scalars, scale: Scalars, same_direction: Flags, cones: Counts
):  # fmt: skip
    """Compute gradient and Hessian after a step.

    If nothing changed in a world, the cost was quadratic along the step. Then the gradient keeps its direction: it
    is multiplied by ``scale``, and the next step has the same direction.
    """
    world, lane = wp.tid()
    if done[world]:
        return
    if changed[world] == 0:
        if lane == 0:
            old = scale[world]
            new = old - alpha[world]
            ratio = float(0.0)
            if old != 0.0:
                ratio = new / old
            gradient_square[world] = gradient_square[world] * ratio * ratio
            decrement[world] = decrement[world] * ratio * ratio
            scale[world] = new
            same_direction[world] = True
        return
    if lane == 0:
        gradient_square[world] = 0.0
        scale[world] = 1.0
        same_direction[world] = False
    for i in range(lane, nv, lanes):
        gradient[world, i] = inertial[world, i] - smooth[world, i]
    wait()
    for row in range(lane, rows[world], lanes):
        push = force[world, row]
        if push != 0.0:
            at = first[world, row]
            for k in range(support[world, row]):
                wp.atomic_sub(gradient, world, columns[world, 0, at + k], push * jacobian[world, 0, at + k])
    wait()
    square = float(0.0)
    for i in range(lane, nv, lanes):
        square += gradient[world, i] * gradient[world, i]
    wp.atomic_add(gradient_square, world, square)
    for change in range(rows_changed[world]):
        row = changed_rows[world, change]
        stiffness = -weight[world, row]
        if zone[world, row] == wp.static(_QUADRATIC):
            stiffness = weight[world, row]
        at = first[world, row]
        width = support[world, row]
        for entry in range(lane, width * (width + 1) // 2, lanes):
            place = _entry(entry)
            i = columns[world, 0, at + place[0]]
            j = columns[world, 0, at + place[1]]
            value = stiffness * jacobian[world, 0, at + place[0]] * jacobian[world, 0, at + place[1]]
            upper = wp.min(i, j)
            right = wp.max(i, j)
            base[world, upper, right] = base[world, upper, right] + value
        wait()
    found = _with_cones(
        world, lane, lanes, impratio_invsqrt, friction, dim, contact, head, height, blocks, support, first, columns,
        jacobian, weight, zone, residual, base, hessian
    )  # fmt: skip
    if lane == 0:
        cones[world] = found


@wp.kernel(enable_backward=False)
def _finish(
    tolerance: Scalars, most: int, inertia_scale: Scalars, gradient_square: Scalars, decrement: Scalars,
    improvement: Scalars, alpha: Scalars, cones: Counts, steps: Counts, overflow: Counts, solving: Counts, done: Flags,
    same_direction: Flags, rows_changed: Counts, changed: Counts
):  # fmt: skip
    """Mark worlds that have converged or reached the iteration limit as done.

    In all other worlds, the counters of changes are reset for the next iteration.
    """
    world = wp.tid()
    if done[world]:
        return
    steps[world] = steps[world] + 1
    unit = inertia_scale[world]
    bound = tolerance[world % tolerance.shape[0]]
    gained = unit * improvement[world]
    converged = alpha[world] == 0.0 or (gained > 0.0 and gained < bound)
    converged = converged or unit * wp.sqrt(gradient_square[world]) < bound or 0.5 * unit * decrement[world] < bound
    if converged or steps[world] == most:
        if not converged:
            overflow[world] = overflow[world] | wp.static(_LIMIT_REACHED)
        done[world] = True
        same_direction[world] = True  # leaves out the products with its direction
        wp.atomic_sub(solving, 0, 1)
        return
    rows_changed[world] = 0
    changed[world] = cones[world]

"""Solver of the implicit integrator's linear system, with one warp of threads per world (mujoco_warp has one thread).

The matrix is sparse and has mujoco_warp's D structure: besides the diagonal, it has entries only for pairs of degrees
of freedom of which one is an ancestor of the other. Elimination begins with the last degree of freedom and therefore
creates no fill-in. The results equal mujoco_warp's, bit for bit.
"""
# pyright: reportIndexIssue=false, reportAttributeAccessIssue=false, reportOperatorIssue=false
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportOptionalMemberAccess=false

from itertools import product

import mujoco_warp as mjw
import numpy as np
import warp as wp
from mujoco_warp._src import forward

_LANES = 32

Indices = wp.array[int]
Numbers = wp.array2d[float]


@wp.func_native(snippet="WP_TILE_SYNC();")
def wait() -> None:
    """Wait until all threads of the world have reached this point."""
    ...


@wp.kernel(enable_backward=False)
def _solve(
    lanes: int, rows: Indices, diagonal: Indices, columns: Indices, first_update: Indices, updates: wp.array2d[int],
    first_of_level: Indices, by_level: Indices, right: Numbers, lu: Numbers, x: Numbers
):  # fmt: skip
    """Factorise the matrix ``lu`` (num, nD) in place, and solve ``lu x = right`` for ``x`` (num, nv) in each world."""
    world, lane = wp.tid()
    nv = diagonal.shape[0]
    for back in range(nv):
        i = nv - 1 - back
        pivot = lu[world, rows[i] + diagonal[i]]
        for k in range(first_update[i] + lane, first_update[i + 1], lanes):
            factor = lu[world, updates[k, 0]] / pivot
            lu[world, updates[k, 2]] = lu[world, updates[k, 2]] - lu[world, updates[k, 1]] * factor
        wait()
        ancestors = diagonal[i]  # every ancestor's row has been updated, and the factors stay
        for a in range(lane, ancestors, lanes):
            k = updates[first_update[i] + a * ancestors, 0]
            lu[world, k] = lu[world, k] / pivot
    wait()
    levels = first_of_level.shape[0] - 1
    for back in range(levels):
        level = levels - 1 - back
        for k in range(first_of_level[level] + lane, first_of_level[level + 1], lanes):
            i = by_level[k]
            total = right[world, i]
            for at in range(rows[i] + diagonal[i] + 1, rows[i + 1]):
                total = total - lu[world, at] * x[world, columns[at]]
            x[world, i] = total
        wait()
    for level in range(levels):
        for k in range(first_of_level[level] + lane, first_of_level[level + 1], lanes):
            i = by_level[k]
            total = x[world, i]
            for at in range(rows[i], rows[i] + diagonal[i]):
                total = total - lu[world, at] * x[world, columns[at]]
            x[world, i] = total / lu[world, rows[i] + diagonal[i]]
        wait()


class ImplicitSolver:
    """Replacement for ``mjw.implicit`` that integrates a model with the fully implicit integrator."""

    def __init__(self, m: mjw.Model) -> None:
        """Precompute, on the model's device, the matrix entries that the elimination of each row updates."""
        starts, diagonal, columns = (a.numpy().astype(np.int32) for a in (m.D_rowadr, m.D_diag, m.D_colind))
        rows = np.append(starts, len(columns)).astype(np.int32)
        place: dict[tuple[int, int], int] = {}
        for i in range(m.nv):
            for k in range(rows[i], rows[i + 1]):
                place[i, int(columns[k])] = k
        updates = []
        first = [0]
        for i in range(m.nv):
            ancestors = columns[rows[i] : rows[i] + diagonal[i]].tolist()
            updates += [(place[j, i], place[i, k], place[j, k]) for j, k in product(ancestors, repeat=2)]
            first.append(len(updates))
        by_level = np.argsort(diagonal, kind="stable")  # an ancestor has fewer ancestors than its descendants
        levels = np.searchsorted(diagonal[by_level], np.arange(diagonal.max() + 2))
        arrays = (rows, diagonal, columns, first, np.reshape(updates, (-1, 3)), levels, by_level)
        self._arrays = [wp.array(np.asarray(a, dtype=np.int32), dtype=int, device=m.D_colind.device) for a in arrays]

    def solve(self, right: wp.array, lu: wp.array, x: wp.array) -> None:
        """Factorise ``lu``, shape (num, nD), in place, and solve ``lu x = right`` for ``x``, shape (num, nv)."""
        lanes = _LANES if lu.device.is_cuda else 1
        inputs = [lanes, *self._arrays, right]
        wp.launch(_solve, (lu.shape[0], lanes), inputs, [lu, x], device=lu.device, block_dim=lanes)

    def integrate(self, m: mjw.Model, d: mjw.Data) -> None:
        """Advance one step from the state and its accelerations; ``m`` may be a leaner copy of the model."""
        forward.implicit_qlu(m, d)
        qacc = wp.empty((d.nworld, m.nv), dtype=float)
        self.solve(d.efc.Ma, d.qLU, qacc)
        forward.implicit_free_body(m, d, d.efc.Ma, qacc, solve=True)
        forward._advance(m, d, qacc)

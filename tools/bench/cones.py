"""Measure how much of the constraint Hessian changes between Newton iterations, for the classes with elliptic cones."""

from collections import Counter

import mujoco
import numpy as np
import warp as wp

from bidex_meta.runs.atomic import Json
from bidex_meta.tasks import registry
from tools.bench.probe import Probe
from tools.bench.stability import variants

_SATISFIED, _QUADRATIC, _CONE = 0, 1, 4
"""Zones of a contact in mujoco_warp's ``ConstraintState``."""


def cones(
    suite: str | None = "MT20-v2",
    task: str | None = None,
    steps: int = 120,
    every: int = 20,
    num_envs: int = 16,
    tolerance: float = 0.01,
    threads: int | None = None,
    seed: int = 0,
) -> Json:
    """Count how often contacts change between Newton iterations.

    A contact can change its zone (satisfied, quadratic or cone) and its part of the Hessian.

    C MuJoCo plays the class's script, or rough actions if the class has no script. At every ``every``-th control step
    mujoco_warp takes over the states on Warp's CPU device and plays one control step. Classes with pyramidal cones are
    left out.

    Args:
        suite: Measure the classes of this suite.
        task: Measure this class instead of a suite.
        steps: Number of control steps.
        every: Number of control steps from one measurement to the next.
        num_envs: Number of environments.
        tolerance: Smallest change of a part that counts, relative to the larger of old and new part (Frobenius norm).
        threads: Engine threads; None: one per CPU.
        seed: Seed of world and actions.

    Returns:
        A row per class; see ``_Counts.shares``.
    """
    table = []
    for name, moving in variants(suite, task):
        if registry.get(name, moving).solver.cone == mujoco.mjtCone.mjCONE_ELLIPTIC:
            probe = Probe(name, num_envs, seed, threads, moving)
            counts = _Counts(probe, tolerance)
            for _ in probe.play(steps, every):
                counts.watch()
            played = "script" if probe.scripted else "rough"
            table.append({"class": name if moving else f"{name} (fixed base)", "played": played} | counts.shares())
            probe.world.close()
    return {"table": table}


class _Counts:
    """Counts changes of contacts and constraint rows over the Newton iterations of an engine on Warp's CPU device."""

    def __init__(self, probe: Probe, tolerance: float) -> None:
        self._probe = probe
        self._tolerance = tolerance
        self._sums: Counter[str] = Counter()

    def watch(self) -> None:
        """Play a control step, and add each iteration of its solver to the counts."""
        from mujoco_warp._src import solver

        plain = solver._solver_iteration

        def counted(m, d, ctx, nsolving: wp.array, compact: bool = False) -> None:
            before = _Contacts(m, d, ctx)
            plain(m, d, ctx, nsolving, compact)
            self._count(before, _Contacts(m, d, ctx))

        solver._solver_iteration = counted
        try:
            self._probe.step()
        finally:
            solver._solver_iteration = plain
        self._sums["solves"] += self._probe.world.num_envs * self._probe.substeps

    def _count(self, before: "_Contacts", after: "_Contacts") -> None:
        solving = ~before.done
        contacts = solving[before.world]
        moved = before.zone != after.zone
        larger = np.maximum(before.size, after.size)
        changed = np.linalg.norm(after.part - before.part, axis=(1, 2)) > self._tolerance * larger
        cone = after.zone == _CONE
        busy = np.zeros(len(solving), bool)
        busy[after.world[moved | cone | (before.zone == _CONE)]] = True
        busy |= (before.others != after.others).any(axis=1)
        self._sums.update(
            loops=1, worlds=int(solving.sum()), still=int((solving & ~busy).sum()), contacts=int(contacts.sum()),
            moved=int((moved & contacts).sum()), changed=int((changed & contacts).sum()),
            active=int((contacts & (after.zone != _SATISFIED)).sum()), cone=int((cone & contacts).sum()),
            rows=int(after.rows[solving].sum()),
            flipped=int((before.quadratic != after.quadratic)[solving].sum()),
            entries=int(after.entries[solving].sum()), of_cones=int(after.of_cones[solving].sum()),
        )  # fmt: skip

    def shares(self) -> Json:
        """Return shares in percent.

        ``active`` (not satisfied), ``cone`` (in the cone zone), ``zone changes`` and ``part changes`` are shares of
        contacts. ``row changes`` is the share of all constraint rows that enter or leave the quadratic zone. ``work of
        cones`` is the share of the products added to the Hessian that come from contacts in the cone zone. ``still`` is
        the share of a world's iterations without a contact in the cone zone and without a change. All shares count
        only worlds that have not converged.

        Three entries are means instead. ``contacts`` is per world and iteration. ``iterations`` counts a world's
        iterations per substep; ``loops`` counts those of the slowest world.
        """
        sums = self._sums

        def percent(part: str, whole: str) -> float:
            return round(100.0 * sums[part] / max(sums[whole], 1), 1)

        return {
            "iterations": round(sums["worlds"] / sums["solves"], 1),
            "loops": round(sums["loops"] * self._probe.world.num_envs / sums["solves"], 1),
            "contacts": round(sums["contacts"] / max(sums["worlds"], 1), 1),
            "active": percent("active", "contacts"),
            "cone": percent("cone", "contacts"),
            "zone changes": percent("moved", "contacts"),
            "part changes": percent("changed", "contacts"),
            "row changes": percent("flipped", "rows"),
            "work of cones": percent("of_cones", "entries"),
            "still": percent("still", "worlds"),
        }


class _Contacts:
    """The contacts of all worlds in one iteration, each with its zone and its part of the Hessian."""

    def __init__(self, m, d, ctx) -> None:
        self.done = ctx.done.numpy().copy()
        state = d.efc.state.numpy().copy()
        rows = np.minimum(d.nefc.numpy(), state.shape[1])
        held = np.arange(state.shape[1]) < rows[:, None]
        self.rows = rows.copy()
        self.quadratic = held & (state == _QUADRATIC)
        weight = d.efc.D.numpy()
        jaref = ctx.Jaref.numpy()
        number = int(d.nacon.numpy()[0])
        address = d.contact.efc_address.numpy()[:number]
        first = address[:, 0]
        held_ones = np.flatnonzero(first >= 0)
        first = first[held_ones]
        self.world = d.contact.worldid.numpy()[held_ones].copy()
        dims = d.contact.dim.numpy()[held_ones]
        self.zone = state[self.world, first]
        contact_rows = np.zeros_like(held)
        others = np.arange(6)
        columns = np.minimum(first[:, None] + others, state.shape[1] - 1)
        inside = others < dims[:, None]
        contact_rows[np.repeat(self.world, dims), columns[inside]] = True
        self.others = np.where(held & ~contact_rows, state, -1)
        d_of = np.where(inside, weight[self.world[:, None], columns], 0.0)
        x = np.where(inside, jaref[self.world[:, None], columns], 0.0)
        friction = d.contact.friction.numpy()[held_ones]
        mu = friction[:, 0] * m.opt.impratio_invsqrt.numpy()[0]
        z = np.concatenate((mu[:, None], friction), axis=1) * inside
        self.part = _parts(self.zone, d_of, x, z, mu)
        self.size = np.linalg.norm(self.part, axis=(1, 2))
        self._weigh(d, state)

    def _weigh(self, d, state: np.ndarray) -> None:
        """Count the entries that each world's blocks of rows add to the Hessian."""
        head = d.efc.jtdaj_adr.numpy()
        blocks = np.arange(head.shape[1]) < d.efc.jtdaj_nblock.numpy()[:, None]
        worlds, places = np.nonzero(blocks)
        heads = head[worlds, places]
        height = d.efc.jtdaj_nrow.numpy()[worlds, places]
        support = d.efc.J_rownnz.numpy()[worlds, heads]
        zone = state[worlds, heads]
        entries = support * (support + 1) // 2 * height * (zone != _SATISFIED)
        self.entries = np.bincount(worlds, entries, len(head))
        self.of_cones = np.bincount(worlds, entries * (zone == _CONE), len(head))


def _parts(zone: np.ndarray, weight: np.ndarray, x: np.ndarray, z: np.ndarray, mu: np.ndarray) -> np.ndarray:
    """Return the second derivatives of k contacts' costs with respect to their residuals, (k, 6, 6)."""
    part = np.zeros((len(zone), 6, 6))
    quadratic = zone == _QUADRATIC
    part[quadratic] = weight[quadratic, :, None] * np.eye(6)
    cone = zone == _CONE
    u = x[cone] * z[cone]
    n = u[:, 0]
    tangent = u.copy()
    tangent[:, 0] = 0.0
    t = np.maximum(np.linalg.norm(tangent, axis=1), 1e-15)
    way = tangent / t[:, None]
    m = mu[cone]
    # With u = z x: cost = dm / 2 (n - mu t)^2 of n = mu x0 and the tangent's length t.
    slope = -m[:, None] * way
    slope[:, 0] = 1.0
    bend = np.eye(6) - way[:, :, None] * way[:, None, :]
    bend[:, 0, 0] = 0.0
    by_u = slope[:, :, None] * slope[:, None, :] + ((m * (m * t - n) / t)[:, None, None]) * bend
    factor = weight[cone, 0] / (m**2 * (1.0 + m**2))
    part[cone] = factor[:, None, None] * by_u * z[cone][:, :, None] * z[cone][:, None, :]
    return part

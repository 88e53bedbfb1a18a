"""Count the kernels of a physics step, and the memory that their array arguments hold."""

from collections.abc import Callable, Sequence
from contextlib import contextmanager
from typing import Any

import warp as wp

from bidex_meta.runs.atomic import Json
from tools.bench.probe import Probe


def launches(
    task: str = "DoorOpenOutward-v2",
    num_envs: int = 32,
    steps: int = 100,
    every: int = 20,
    most: int = 10,
    switches: str = "",
    threads: int | None = None,
    seed: int = 0,
) -> Json:
    """List the kernels of a physics substep, sorted by the size of the arrays that they access.

    C MuJoCo plays the class's script, or rough actions if the class has no script. mujoco_warp takes over the states on
    Warp's CPU device, where the kernels are counted. The memory of a kernel is the size of its array arguments whose
    first dimension is the world. It is the allocated size, of which only a part may be in use. A world that has
    converged reads almost nothing. Kernels in Newton's iterations are therefore counted only for worlds that still
    iterate.

    Args:
        task: Class to play.
        num_envs: Number of environments.
        steps: Number of control steps.
        every: Number of control steps from one measurement to the next.
        most: Largest number of kernels in the table.
        switches: As in ``Benchmark.make_world``.
        threads: Engine threads of C MuJoCo; None: one per CPU.
        seed: Seed of world and actions.

    Returns:
        Number of kernels per substep, kB per world and substep, and a row per kernel: ``launches`` per substep,
        ``passes`` (launches per world, which are fewer in Newton's iterations), and the kB that a world reads and
        writes per substep.
    """
    probe = Probe(task, num_envs, seed, threads, switches=switches)
    watched = _Launches(num_envs)
    substeps = 0
    for _ in probe.play(steps, every):
        with watched.counting():
            probe.step()
        substeps += probe.substeps
    probe.world.close()
    return watched.table(substeps, most)


class _Launches:
    """Counts the launches of each kernel, and the bytes per world of their arguments."""

    def __init__(self, num_envs: int) -> None:
        self._num = num_envs
        self._kernels: dict[str, dict[str, float]] = {}
        self._share = 1.0

    @contextmanager
    def counting(self):
        """Count all launches of kernels in this context, and the passes, which are launches per world.

        In Newton's iterations a launch counts as a pass only for the share of worlds whose solver has not converged.
        """
        from mujoco_warp._src import solver

        from bidex_meta.engine import newton

        changes = [(wp, name, self._counted) for name in ("launch", "launch_tiled")]
        changes += [(module, "_solver_iteration", self._shared) for module in (solver, newton)]
        theirs = [getattr(module, name) for module, name, _ in changes]
        try:
            for (module, name, change), function in zip(changes, theirs, strict=True):
                setattr(module, name, change(function))
            yield
        finally:
            for (module, name, _), function in zip(changes, theirs, strict=True):
                setattr(module, name, function)

    def _shared(self, iteration: Callable[..., None]) -> Callable[..., None]:
        def shared(m: Any, d: Any, ctx: Any, nsolving: wp.array, compact: bool = False) -> None:
            self._share = float(1.0 - ctx.done.numpy().mean())
            iteration(m, d, ctx, nsolving, compact)
            self._share = 1.0

        return shared

    def _counted(self, launch: Callable[..., Any]) -> Callable[..., Any]:
        def counted(kernel: wp.Kernel, dim: Any, inputs: Sequence = (), outputs: Sequence = (), **named: Any) -> Any:
            sizes = [dim] if isinstance(dim, int) else list(dim)
            if 0 not in sizes:  # Warp launches nothing over an empty range
                self._add(_name(kernel), inputs, outputs)
            return launch(kernel, dim=dim, inputs=inputs, outputs=outputs, **named)

        return counted

    def _add(self, kernel: str, inputs: Sequence, outputs: Sequence) -> None:
        row = self._kernels.setdefault(kernel, {"launches": 0.0, "passes": 0.0, "read": 0.0, "written": 0.0})
        row["launches"] += 1.0
        row["passes"] += self._share
        row["read"] += self._share * self._bytes(inputs)
        row["written"] += self._share * self._bytes(outputs)

    def _bytes(self, arguments: Sequence) -> float:
        """Return the bytes per world of the arrays; arrays of the model, which all worlds share, are not counted."""
        arrays = [each for each in arguments if isinstance(each, wp.array) and each.size]
        mine = [array for array in arrays if array.shape[0] and array.shape[0] % self._num == 0]
        return sum(array.size * wp.types.type_size_in_bytes(array.dtype) for array in mine) / self._num

    def table(self, substeps: int, most: int) -> Json:
        """Return totals, and a table of the ``most`` kernels that access most memory, as means over substeps."""
        rows = []
        for kernel, sums in self._kernels.items():
            mean = {name: value / substeps for name, value in sums.items()}
            memory = {f"kB {name}": round(mean[name] / 1000.0, 1) for name in ("read", "written")}
            counts = {name: round(mean[name], 1) for name in ("launches", "passes")}
            rows.append({"kernel": kernel} | counts | memory)
        rows.sort(key=lambda row: -row["kB read"] - row["kB written"])
        total = sum(row["kB read"] + row["kB written"] for row in rows)
        count = sum(row["launches"] for row in rows)
        return {"kernels": round(count, 1), "kB per world": round(total, 1), "table": rows[:most]}


def _name(kernel: wp.Kernel) -> str:
    """Return the name of the function in which a kernel is defined, or the kernel's own name if there is none."""
    holder, _, own = kernel.func.__qualname__.replace(".<locals>", "").rpartition(".")
    return holder or own

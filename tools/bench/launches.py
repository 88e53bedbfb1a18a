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
    """List the kernels of a substep by the memory that they pass over, on Warp's CPU device from real states.

    C MuJoCo plays the class as in ``cones``. The memory of a kernel is the size of its array arguments, whose first
    dimension is the world: the room that is reserved, not what is in use. A world that has converged reads almost
    nothing, so that kernels of Newton's iterations count once for each iteration of a world, not of the slowest one.

    Args:
        task: Class.
        num_envs: Environments.
        steps: Control steps.
        every: Control steps from one measurement to the next.
        most: Kernels that are listed.
        switches: As in ``Benchmark.make_world``.
        threads: Engine threads of C MuJoCo; None takes all CPUs.
        seed: Seed of world and actions.

    Returns:
        Kernels per substep and kB per world and substep, and a row per kernel: ``launches`` of a substep, ``passes`` of
        a world (less in Newton's iterations), kB that a world reads and writes in all its passes.
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
    """Launches by kernel, with the bytes per world of their arguments."""

    def __init__(self, num_envs: int) -> None:
        self._num = num_envs
        self._kernels: dict[str, dict[str, float]] = {}
        self._share = 1.0

    @contextmanager
    def counting(self):
        """Count all launches in this context; within Newton's iterations by the share of worlds that still iterate."""
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
        """Return the bytes of a world in its arrays; arrays of the model, which all worlds share, do not count."""
        arrays = [each for each in arguments if isinstance(each, wp.array) and each.size]
        mine = [array for array in arrays if array.shape[0] and array.shape[0] % self._num == 0]
        return sum(array.size * wp.types.type_size_in_bytes(array.dtype) for array in mine) / self._num

    def table(self, substeps: int, most: int) -> Json:
        """Return the means over substeps."""
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
    """Return the function that holds a kernel, if the kernel has no name of its own, else the kernel's name."""
    holder, _, own = kernel.func.__qualname__.replace(".<locals>", "").rpartition(".")
    return holder or own

"""The worker of ``tools.bench.against``, which steps the worlds of the checkout that is first on the import path.

The worker is started by its file name and imports another commit's ``bidex_meta``, so the worker may use only names
that commit e0e28c4 has too. A command is a line of JSON on stdin, and the answer is a line of JSON on stdout.
"""

import json
import os
import sys
import time
from pathlib import Path
from typing import Any


class Stepper:
    """Builds one world at a time and steps it."""

    def __init__(self) -> None:
        self._world: Any = None

    def classes(self, checkout: str, suite: str, seed: int) -> list[str]:
        """Return the names of the train classes of a suite in the code under ``checkout``."""
        import bidex_meta

        found = Path(bidex_meta.__file__).resolve().parents[1]
        if found != Path(checkout).resolve():
            raise RuntimeError(f"expected bidex_meta of {checkout}, but Python imports that of {found}")
        return list(bidex_meta.Benchmark(suite, seed=seed).train_classes)

    def build(self, suite: str, task: str | None, num_envs: int, threads: int | None, seed: int) -> list[list[float]]:
        """Make and reset the world of a suite, or of one of the suite's classes.

        Returns time step (seconds) and substeps of each engine batch, or [] if the checkout stores them elsewhere.
        """
        from bidex_meta import Benchmark

        if self._world is not None:
            self._world.close()
        benchmark = Benchmark(suite, seed=seed)
        if task is None:
            self._world = benchmark.make_world("train", device="cpu", num_envs=num_envs, threads=threads)
        else:
            self._world = _world_of(_slot(benchmark, task), num_envs, seed=seed, threads=threads)
        self._world.reset(seed=seed)
        try:
            parts = [(part.group.members[0].scene.model, part.substeps) for part in self._world.parts]
            return [[float(model.opt.timestep), int(substeps)] for model, substeps in parts]
        except AttributeError:
            return []

    def step(self, steps: int, seed: int) -> dict[str, float]:
        """Step all environments under uniform actions; return ``wall`` and ``cpu`` seconds without the first step."""
        import torch

        generator = torch.Generator().manual_seed(seed)
        shape = steps + 1, self._world.num_envs, *self._world.single_action_space.shape
        first, *actions = 2.0 * torch.rand(shape, generator=generator) - 1.0
        self._world.step(first)  # not measured: the other worker has run in between, so the caches are cold
        wall, cpu = time.perf_counter(), time.process_time()
        for action in actions:
            self._world.step(action)
        return {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}


def _world_of(slot: Any, num_envs: int, **settings: object) -> Any:
    from bidex_meta import world

    module: Any = world
    if not hasattr(module, "WorldConfig"):
        return module.World([slot], num_envs, **settings)  # older code takes the settings as arguments
    return module.World([slot], module.WorldConfig(num_envs, **settings))


def _slot(benchmark: Any, task: str) -> Any:
    import numpy as np

    from bidex_meta.world import Slot

    variations = [one.variation for one in benchmark.train_tasks if one.env_name in (task, f"{task}-v2")]
    task_class = benchmark.train_classes[task]
    task_class = getattr(task_class, "task_class", task_class)  # older code has descriptions here
    return Slot(task, task_class, np.stack(variations))


def main() -> None:
    """Answer commands until stdin ends."""
    # Output of a library must not mix with the answers.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    stepper = Stepper()
    for line in sys.stdin:
        name, given = json.loads(line)
        try:
            answer = {"answer": getattr(stepper, name)(**given)}
        except Exception as error:
            answer = {"error": " ".join(str(error).split()) or type(error).__name__}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()

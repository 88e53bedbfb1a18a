"""Speed as ratios within one process."""

import statistics
import time
from typing import Any

import torch

from bidex_meta.benchmark import Benchmark
from bidex_meta.engine.cpu import default_threads
from bidex_meta.world import Slot, World


def scaling(
    suite: str = "MT4", num_envs: int = 1024, steps: int = 40, repeats: int = 5, seed: int = 0
) -> dict[str, Any]:
    """Speed of the world over engine threads, repeats interleaved.

    Returns:
        ``env_steps_per_s`` by number of threads and ``speedup`` against one thread.
    """
    counts = sorted({1, 2, default_threads()} & set(range(1, default_threads() + 1)))
    worlds = {
        n: Benchmark(suite, seed=seed).make_world("train", device="cpu", num_envs=num_envs, threads=n) for n in counts
    }
    speeds: dict[int, list[float]] = {n: [] for n in counts}
    for made in worlds.values():
        made.reset(seed=seed)
    for repeat in range(repeats + 1):
        for n, made in worlds.items():
            generator = torch.Generator().manual_seed(repeat)
            start = time.perf_counter()
            for _ in range(steps):
                made.step(2.0 * torch.rand(num_envs, made.action_size, generator=generator) - 1.0)
            if repeat:  # the first one warms up
                speeds[n].append(num_envs * steps / (time.perf_counter() - start))
    median = {n: statistics.median(v) for n, v in speeds.items()}
    return {
        "suite": suite,
        "num_envs": num_envs,
        "env_steps_per_s": {str(n): round(v) for n, v in median.items()},
        "speedup": {str(n): round(v / median[1], 3) for n, v in median.items()},
    }


def mixing(
    suite: str = "MT20",
    num_envs: int = 2000,
    steps: int = 20,
    repeats: int = 3,
    threads: int | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """Speed of a suite's world against its classes run alone with as many rows.

    A world that mixes classes should cost no more than their mean: the yardstick is the harmonic mean of the classes'
    speeds. The mixed world is measured before, among and after the classes, which are built one at a time.

    Returns:
        ``mixed``, ``harmonic_mean`` (environment steps per second), their ``ratio``, and per class ``env_steps_per_s``,
        ``nv``, ``ngeom`` and ``group``, the number of its engine batch in the mixed world.
    """
    benchmark = Benchmark(suite, seed=seed)
    full = benchmark.make_world("train", device="cpu", num_envs=num_envs, threads=threads)
    full.reset(seed=seed)
    mixed, classes = [_speed(full, steps)], {}
    for i, slot in enumerate(full.slots):
        part = next(p for p in full.parts if any(m.slot == i for m in p.group.members))
        model = next(m for m in part.group.members if m.slot == i).scene.model
        alone = World([Slot(slot.name, slot.task_class, slot.tasks)], num_envs, seed=seed, threads=threads)
        alone.reset(seed=seed)
        _speed(alone, 5)
        speeds = [_speed(alone, steps) for _ in range(repeats)]
        alone.close()
        mixed.append(_speed(full, steps))
        classes[slot.name] = {
            "env_steps_per_s": round(statistics.median(speeds)),
            "nv": model.nv,
            "ngeom": model.ngeom,
            "group": full.parts.index(part),
        }
    harmonic = statistics.harmonic_mean([row["env_steps_per_s"] for row in classes.values()])
    return {
        "suite": suite,
        "num_envs": num_envs,
        "threads": threads or default_threads(),
        "mixed": round(statistics.median(mixed[1:])),
        "harmonic_mean": round(harmonic),
        "ratio": round(statistics.median(mixed[1:]) / harmonic, 4),
        "classes": classes,
    }


def _speed(made: World, steps: int) -> float:
    """Environment steps per second under random actions."""
    generator = torch.Generator().manual_seed(0)
    actions = [2.0 * torch.rand(made.num_envs, made.action_size, generator=generator) - 1.0 for _ in range(steps)]
    start = time.perf_counter()
    for action in actions:
        made.step(action)
    return made.num_envs * steps / (time.perf_counter() - start)

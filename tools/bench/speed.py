"""Speed of a suite's world over threads, and over that of its classes alone, as ratios within one process."""

import statistics
from typing import Any

from bidex_meta.benchmark import Benchmark
from bidex_meta.utils.memory import usable_cores
from bidex_meta.world import Slot, World, WorldConfig
from tools.bench.timing import random_steps


def scaling(
    suite: str = "MT4", num_envs: int = 1024, steps: int = 40, repeats: int = 5, seed: int = 0
) -> dict[str, Any]:
    """Speed of the world over engine threads, repeats interleaved.

    Args:
        suite: Suite to step.
        num_envs: Environments.
        steps: Environment steps of each repeat.
        repeats: Interleaved repeats; medians are reported.
        seed: Seed of the worlds.

    Returns:
        ``env_steps_per_s`` by number of threads and ``speedup`` against one thread.
    """
    most = usable_cores()
    worlds = {
        n: Benchmark(suite, seed=seed).make_world("train", device="cpu", num_envs=num_envs, threads=n)
        for n in sorted({1, min(2, most), most})
    }
    speeds: dict[int, list[float]] = {n: [] for n in worlds}
    for world in worlds.values():
        world.reset(seed=seed)
        _speed(world, steps)  # warms up
    for repeat in range(repeats):
        for n, world in worlds.items():
            speeds[n].append(_speed(world, steps, repeat))
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
    """Speed of a suite's world against its classes run alone with as many environments.

    A world that mixes classes should cost no more than their mean: the yardstick is the harmonic mean of the classes'
    speeds. The mixed world is measured after each class; these are built one at a time.

    Args:
        suite: Suite to step.
        num_envs: Environments of each world.
        steps: Environment steps of each repeat.
        repeats: Repeats of each class; medians are reported.
        threads: Engine threads; None takes all CPUs.
        seed: Seed of the worlds.

    Returns:
        ``mixed``, ``harmonic_mean`` (environment steps per second), their ``ratio``, and per class ``env_steps_per_s``,
        ``nv``, ``ngeom`` and ``group``, the number of its engine batch in the mixed world.
    """
    full = Benchmark(suite, seed=seed).make_world("train", device="cpu", num_envs=num_envs, threads=threads)
    full.reset(seed=seed)
    _speed(full, steps)  # warms up
    mixed, classes = [], {}
    for i, slot in enumerate(full.slots):
        part, member = next((p, m) for p in full.parts for m in p.group.members if m.slot == i)
        alone = World([Slot(slot.name, slot.task_class, slot.tasks)], WorldConfig(num_envs, seed=seed, threads=threads))
        alone.reset(seed=seed)
        _speed(alone, 5)
        speed = statistics.median(_speed(alone, steps) for _ in range(repeats))
        alone.close()
        mixed.append(_speed(full, steps))
        classes[slot.name] = {
            "env_steps_per_s": round(speed),
            "nv": member.scene.model.nv,
            "ngeom": member.scene.model.ngeom,
            "group": full.parts.index(part),
        }
    harmonic = statistics.harmonic_mean([row["env_steps_per_s"] for row in classes.values()])
    return {
        "suite": suite,
        "num_envs": num_envs,
        "threads": threads or usable_cores(),
        "mixed": round(statistics.median(mixed)),
        "harmonic_mean": round(harmonic),
        "ratio": round(statistics.median(mixed) / harmonic, 4),
        "classes": classes,
    }


def _speed(world: World, steps: int, seed: int = 0) -> float:
    """Environment steps per second under random actions."""
    return world.num_envs * steps / random_steps(world, steps, seed).wall

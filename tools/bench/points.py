"""What point clouds cost: a world that shows them beside the same world that shows objects' states."""

import statistics
from typing import Any

from bidex_meta.benchmark import make_task_world
from bidex_meta.utils.memory import usable_cores
from tools.bench.timing import Seconds, random_steps


def points(
    task: str = "HandOver",
    num_envs: int = 256,
    count: int = 768,
    steps: int = 20,
    repeats: int = 7,
    threads: int | None = None,
    device: str = "cpu",
    seed: int = 0,
) -> dict[str, Any]:
    """Speed of a class with point clouds and with states, in turns within one process.

    Args:
        task: The class.
        num_envs: Environments.
        count: Points of a cloud.
        steps: Environment steps of each repeat.
        repeats: Repeats in turns; medians are reported.
        threads: Engine threads; None takes all CPUs.
        device: ``cpu`` or ``cuda:N``.
        seed: Seed of the worlds.

    Returns:
        Frames (environment steps over all environments) a second with ``points`` and ``state``, the same per CPU
        second of the process, their ``ratio`` (of CPU seconds), and ``cloud_ms``: CPU milliseconds a step takes more.
    """
    worlds = {
        name: make_task_world(task, num_envs, device, seed=seed, autoreset_mode="SAME_STEP", threads=threads, points=n)
        for name, n in (("points", count), ("state", 0))
    }
    for world in worlds.values():
        world.reset(seed=seed)
        random_steps(world, 3)
    times: dict[str, list[Seconds]] = {name: [] for name in worlds}
    for repeat in range(repeats):
        for name, world in worlds.items():
            times[name].append(random_steps(world, steps, repeat))
    frames = num_envs * steps
    pairs = [(p.cpu, s.cpu) for p, s in zip(times["points"], times["state"], strict=True)]
    return {
        "task": task,
        "num_envs": num_envs,
        "points": count,
        "threads": threads or usable_cores(),
        "frames_per_s": {n: round(statistics.median(frames / t.wall for t in took)) for n, took in times.items()},
        "frames_per_cpu_s": {n: round(statistics.median(frames / t.cpu for t in took)) for n, took in times.items()},
        "ratio": round(statistics.median(s / p for p, s in pairs), 3),
        "cloud_ms": round(1000.0 * statistics.median((p - s) / steps for p, s in pairs), 1),
    }

"""What point clouds cost: a world that shows them beside the same world that shows objects' states."""

import statistics
import time
from typing import Any

import torch

from bidex_meta.benchmark import make_task_world
from bidex_meta.engine.cpu import default_threads
from bidex_meta.world import World


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
        num_envs: Rows.
        count: Points of a cloud.
        steps: Environment steps of each repeat.
        repeats: Repeats in turns; medians are reported.
        threads: Engine threads; None takes all CPUs.
        device: ``cpu`` or ``cuda:N``.
        seed: Of worlds and actions.

    Returns:
        Frames (environment steps of all rows) a second with ``points`` and ``state``, the same per CPU second of the
        process, their ``ratio`` (of CPU seconds), and ``cloud_ms``: CPU milliseconds that a step takes more.
    """
    worlds = {
        name: make_task_world(task, num_envs, device, seed=seed, autoreset_mode="SAME_STEP", threads=threads, points=n)
        for name, n in (("points", count), ("state", 0))
    }
    for world in worlds.values():
        world.reset(seed=seed)
        _seconds(world, 3, torch.Generator().manual_seed(seed))
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in worlds}
    for repeat in range(repeats):
        for name, world in worlds.items():
            times[name].append(_seconds(world, steps, torch.Generator().manual_seed(repeat)))
    frames = num_envs * steps
    wall = {name: round(statistics.median(frames / t for t, _ in found)) for name, found in times.items()}
    busy = {name: round(statistics.median(frames / c for _, c in found)) for name, found in times.items()}
    pairs = [(p[1], s[1]) for p, s in zip(times["points"], times["state"], strict=True)]
    return {
        "task": task,
        "num_envs": num_envs,
        "points": count,
        "threads": threads or default_threads(),
        "frames_per_s": wall,
        "frames_per_cpu_s": busy,
        "ratio": round(statistics.median(s / p for p, s in pairs), 3),
        "cloud_ms": round(1000.0 * statistics.median((p - s) / steps for p, s in pairs), 1),
    }


def _seconds(world: World, steps: int, generator: torch.Generator) -> tuple[float, float]:
    """Seconds, and CPU seconds of the process, that so many steps of random actions take."""
    actions = [2.0 * torch.rand(world.num_envs, world.action_size, generator=generator) - 1.0 for _ in range(steps)]
    start, busy = time.perf_counter(), time.process_time()
    for action in actions:
        world.step(action.to(world.device))
    if world.device.type == "cuda":
        torch.cuda.synchronize(world.device)
    return time.perf_counter() - start, time.process_time() - busy

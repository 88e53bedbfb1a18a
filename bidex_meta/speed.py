"""How fast a suite's world is stepped here, and how fast its physics alone would be (``bidex-meta bench world``)."""

import statistics
import time
from typing import Any

import torch

from bidex_meta.benchmark import Benchmark
from bidex_meta.utils.memory import usable_cores
from bidex_meta.world import World


def world_speed(
    suite: str,
    num_envs: int,
    steps: int,
    repeats: int,
    threads: int | None = None,
    device: str = "cpu",
    engine: str = "auto",
    seed: int = 0,
) -> dict[str, Any]:
    """Speed of the whole world against bare engine steps, in turns within one process.

    The engines of a second world are stepped bare: the same states, controls, threads, sensors and substeps. They
    follow the first world's resets outside the clock, so both do the same physics.

    Args:
        suite: Suite to step.
        num_envs: Environments stepped together.
        steps: Environment steps of each repeat, at least 1.
        repeats: Interleaved repeats, at least 1; medians are reported.
        threads: Threads of the CPU engine; None takes all CPUs.
        device: As in ``Benchmark.make_world``.
        engine: As in ``Benchmark.make_world``.
        seed: Seed of world and actions.

    Returns:
        ``env_steps_per_s``, ``engine_steps_per_s`` (also in environment steps), their ``ratio``, and ``groups``: the
        number of environments in each engine batch.

    Raises:
        BidexError: What ``Benchmark.make_world`` refuses.
    """
    full, bare = (
        Benchmark(suite, seed=seed).make_world(
            "train", device=device, num_envs=num_envs, threads=threads, engine=engine
        )
        for _ in range(2)
    )
    full.reset(seed=seed)
    bare.reset(seed=seed)
    generator = torch.Generator().manual_seed(seed)
    paired_steps(full, bare, 10, generator)
    times = [paired_steps(full, bare, steps, generator) for _ in range(repeats)]
    done = num_envs * steps
    return {
        "suite": suite,
        "num_envs": num_envs,
        "threads": threads or usable_cores(),
        "env_steps_per_s": round(statistics.median(done / t for t, _ in times)),
        "engine_steps_per_s": round(statistics.median(done / t for _, t in times)),
        "ratio": round(statistics.median(b / f for f, b in times), 4),
        "groups": [part.group.engine.num for part in full.parts],
    }


def paired_steps(full: World, bare: World, steps: int, generator: torch.Generator) -> tuple[float, float]:
    """Seconds that a world and the bare engines of its twin take for the same random steps."""
    full_time = bare_time = 0.0
    for _ in range(steps):
        action = 2.0 * torch.rand(full.num_envs, full.action_size, generator=generator) - 1.0
        action, number = action.to(full.device), full.episodes.number.clone()
        start = _now(full)
        full.step(action)
        full_time += _now(full) - start
        for part in bare.parts:
            part.control(part.group.take(action))
        start = _now(bare)
        list(bare.step_engines())
        bare_time += _now(bare) - start
        begun = full.episodes.number != number
        for part, source in zip(bare.parts, full.parts, strict=True):
            mask, placement = part.group.take(begun), source.group.engine.placement()
            if mask.any():
                part.group.engine.reset(mask, placement if part.group.engine.masked else placement[mask])
    return full_time, bare_time


def _now(world: World) -> float:
    """Seconds, once all that was asked of the world's device is done."""
    if world.device.type == "cuda":
        torch.cuda.synchronize(world.device)
    return time.perf_counter()

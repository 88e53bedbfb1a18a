"""Speed of a suite's world and of its bare physics."""

import statistics
import time

import torch

from bidex_meta.benchmark import Benchmark
from bidex_meta.runs.atomic import Json
from bidex_meta.utils.memory import usable_cores
from bidex_meta.world import World


def world_speed(
    suite: str, *, num_envs: int, steps: int, repeats: int, threads: int | None, device: str, engine: str, seed: int,
    deterministic: bool = False, switches: str = ""
) -> Json:  # fmt: skip
    """Measure environment steps per second, for a suite's complete world and for its physics engines alone.

    The world and the engines are measured alternately in one process, ``repeats`` times. The results are medians over
    the repeats; ``ratio`` is the median of the repeats' ratios. The bare engines belong to a second world, with the
    same states, controls, threads, sensors and substeps. When the first world resets environments, the bare engines are
    reset to the same states, outside the timed region. ``groups`` has the number of environments in each engine batch.
    """
    options = {"device": device, "num_envs": num_envs, "threads": threads, "engine": engine}
    options |= {"deterministic": deterministic, "switches": switches}
    full, bare = (Benchmark(suite, seed=seed).make_world("train", **options) for _ in range(2))
    full.reset(seed=seed)
    bare.reset(seed=seed)
    generator = torch.Generator().manual_seed(seed)
    paired_steps(full, bare, 10, generator)
    times = [paired_steps(full, bare, steps, generator) for _ in range(repeats)]
    total = num_envs * steps
    return {
        "suite": suite, "num_envs": num_envs, "threads": threads or usable_cores(),
        "env_steps_per_s": round(statistics.median(total / t for t, _ in times)),
        "engine_steps_per_s": round(statistics.median(total / t for _, t in times)),
        "ratio": round(statistics.median(b / f for f, b in times), 4),
        "groups": [part.group.engine.num for part in full.parts],
    }  # fmt: skip


def paired_steps(full: World, bare: World, steps: int, generator: torch.Generator) -> tuple[float, float]:
    """Step two identical worlds with the same random actions, and return the seconds that each world took.

    The world ``full`` takes complete steps. In the world ``bare``, only the physics engines are stepped, and only their
    steps are timed.
    """

    def now() -> float:
        if full.device.type == "cuda":
            torch.cuda.synchronize(full.device)
        return time.perf_counter()

    full_time = bare_time = 0.0
    for _ in range(steps):
        action = 2.0 * torch.rand(full.num_envs, full.action_size, generator=generator) - 1.0
        action = action.to(full.device)
        number = full.episodes.number.clone()
        start = now()
        full.step(action)
        full_time += now() - start
        for part in bare.parts:
            part.control(part.group.take(action))
        start = now()
        bare.step_engines()
        bare_time += now() - start
        begun = full.episodes.number != number
        for part, source in zip(bare.parts, full.parts, strict=True):
            mask = part.group.take(begun)
            placement = source.group.engine.placement()
            if mask.any():
                part.group.engine.reset(mask, placement if part.group.engine.avoids_syncs else placement[mask])
    return full_time, bare_time

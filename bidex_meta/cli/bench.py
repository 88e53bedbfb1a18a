"""``bidex-meta bench world``: measure the speed of a suite's world on this machine."""

import json
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from bidex_meta.cli.parsing import Device, JsonSwitch, parse
from bidex_meta.cli.tables import Json, plain_table, print_table
from bidex_meta.config import Steps
from bidex_meta.errors import BidexError, known_name
from bidex_meta.utils.memory import usable_cores
from bidex_meta.utils.validation import Environments, Few, Seed, Threads

if TYPE_CHECKING:
    from torch import Generator

    from bidex_meta.world import World


@dataclass(frozen=True)
class BenchFlags:
    """Measure how fast a suite's world is stepped here, and how fast its physics alone would be.

    Example: bidex-meta bench world --suite MT4 --num-envs 1024 --json
    """

    what: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="world")]
    """world: environment steps per second of the world and of its bare physics, and their ratio."""
    suite: str = "MT4"  # Suite to measure.
    num_envs: Environments = 1024  # Environments stepped together.
    steps: Steps = 40  # Environment steps of each repeat.
    repeats: Few = 7  # Interleaved repeats; medians are reported.
    threads: Threads | None = None  # Threads of the physics on a CPU; None takes all cores.
    device: Device = "cpu"
    engine: str = "auto"  # auto, c or warp.
    seed: Seed = 0  # Seed of world and actions.
    json: JsonSwitch = False


def main(arguments: Sequence[str]) -> None:
    """Measure and print."""
    flags = parse(BenchFlags, arguments, "bench")
    known_name("bench", flags.what, ["world"])
    if flags.steps == 0:
        raise BidexError("bench world: expected --steps of 1 or more, got 0.")
    result = world_speed(flags)
    if flags.json:
        print(json.dumps(result, indent=2))
        return
    print_table(plain_table(["measure", "value"], list(result.items())))


def world_speed(flags: BenchFlags) -> Json:
    """Measure environment steps per second of the whole world and of bare engines, in turns within one process.

    The results are medians; ``ratio`` is the median of ratios. The bare engines are those of a second world, with the
    same states, controls, threads, sensors and substeps. Outside the timed region the bare engines follow the first
    world's resets, so both do the same physics. ``groups`` has the number of environments in each engine batch.
    """
    import torch

    from bidex_meta.benchmark import Benchmark  # torch and MuJoCo, which --help does not need

    options = {"device": flags.device, "num_envs": flags.num_envs, "threads": flags.threads, "engine": flags.engine}
    full, bare = (Benchmark(flags.suite, seed=flags.seed).make_world("train", **options) for _ in range(2))
    full.reset(seed=flags.seed)
    bare.reset(seed=flags.seed)
    generator = torch.Generator().manual_seed(flags.seed)
    paired_steps(full, bare, 10, generator)
    times = [paired_steps(full, bare, flags.steps, generator) for _ in range(flags.repeats)]
    steps = flags.num_envs * flags.steps
    return {
        "suite": flags.suite, "num_envs": flags.num_envs, "threads": flags.threads or usable_cores(),
        "env_steps_per_s": round(statistics.median(steps / t for t, _ in times)),
        "engine_steps_per_s": round(statistics.median(steps / t for _, t in times)),
        "ratio": round(statistics.median(b / f for f, b in times), 4),
        "groups": [part.group.engine.num for part in full.parts],
    }  # fmt: skip


def paired_steps(full: "World", bare: "World", steps: int, generator: "Generator") -> tuple[float, float]:
    """Return the seconds that a world and the bare engines of its twin take for the same random steps."""
    import torch

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
                part.group.engine.reset(mask, placement if part.group.engine.masked else placement[mask])
    return full_time, bare_time

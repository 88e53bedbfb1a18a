"""Compare the simulation's speed with each of several physics options to its speed with the defaults, on one device."""

import multiprocessing
import statistics
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from pathlib import Path
from typing import Any

import torch

from bidex_meta.benchmark import Benchmark, make_task_world
from bidex_meta.errors import BidexError, one_line
from bidex_meta.runs.atomic import Json, write_json
from bidex_meta.utils.memory import usable_cores
from bidex_meta.world import World
from tools.bench.gpu import RECORDED, known_rows, machine_of, random_steps, training_speed

SWITCHES: dict[str, dict[str, Any]] = {
    "none": {},
    "deterministic": {"deterministic": True},
    "incremental": {"switches": "incremental"},
    "pyramids": {"switches": "pyramids"},
}
"""Arguments of ``Benchmark.make_world`` by name of the switch; add a line to measure another switch."""
_REPLAYED = 50
"""Largest number of steps that are played twice and compared; 50 steps contain contacts."""


def switches(
    suite: str = "MT20-v2",
    sizes: Sequence[int] = (512, 8192, 32768),
    steps: int = 20,
    repeats: int = 5,
    device: str = "cuda:0",
    engine: str = "warp",
    seed: int = 0,
    out: Path | None = None,
) -> Json:
    """Compare the speed of a suite's world with each of ``SWITCHES``; all worlds of a size are stepped alternately.

    Args:
        suite: Suite to step.
        sizes: Numbers of environments. The deterministic world needs so much memory that only the smallest one fits.
        steps: Number of control steps of each repeat.
        repeats: Number of repeats for each world; medians are reported.
        device: Device of the worlds.
        engine: As in ``Benchmark.make_world``.
        seed: Seed of worlds and actions.
        out: File to which each size is written when it is measured; sizes in the file are not measured again.

    Returns:
        ``rows`` by size and switch: ``env_steps_per_s``; ``ratio``, the median speed relative to the world without
        switches; ``training_steps_per_s`` with MT-PPO's preset ``v2``; and ``repeats``, which is true if two episodes
        with equal seeds are equal bit for bit. A switch that cannot be measured has an ``error`` instead.
    """
    setting = {"suite": suite, "device": device, "engine": engine, "steps": steps, "turns": repeats}
    setting["machine"] = machine_of(device)
    rows = known_rows(out, setting)
    for size in sizes:
        if str(size) in rows:
            continue
        worlds: dict[str, World] = {}
        row: Json = {}
        for name, options in SWITCHES.items():
            try:
                world = Benchmark(suite, seed=seed).make_world(
                    "train", num_envs=size, device=device, engine=engine, **options
                )
                world.reset(seed=seed)
                random_steps(world, RECORDED)
            except (BidexError, RuntimeError, TypeError) as error:
                row[name] = {"error": one_line(error)}
                world = None  # frees its memory
            else:
                worlds[name] = world
        row |= _in_turns(worlds, steps, repeats)
        for name, world in worlds.items():
            row[name]["repeats"] = _repeats(world, min(steps, _REPLAYED), seed)
            row[name]["training_steps_per_s"] = training_speed(world, "v2")
            world.close()
        rows[str(size)] = row
        if out is not None:
            write_json(out, {"setting": setting, "rows": rows})
    return {"setting": setting, "rows": rows}


def _in_turns(worlds: dict[str, World], steps: int, repeats: int) -> Json:
    seconds: dict[str, list[float]] = {name: [] for name in worlds}
    for turn in range(repeats):
        order = list(worlds)
        if turn % 2:
            order.reverse()  # otherwise each switch would always run after the same other switch
        for name in order:
            seconds[name].append(random_steps(worlds[name], steps))
    row: Json = {}
    for name, taken in seconds.items():
        row[name] = {"env_steps_per_s": round(worlds[name].num_envs * steps / statistics.median(taken))}
        if "none" in seconds:
            ratios = [plain / own for plain, own in zip(seconds["none"], taken, strict=True)]
            row[name]["ratio"] = round(statistics.median(ratios), 4)
    return row


def _repeats(world: World, steps: int, seed: int) -> bool:
    """Return whether the same actions, played twice from the same seed, end in equal observations."""
    ends = []
    for _ in range(2):
        world.reset(seed=seed)
        random_steps(world, steps)
        ends.append(world.step(torch.zeros(world.num_envs, world.action_size, device=world.device))[0].clone())
    return bool(torch.equal(ends[0], ends[1]))


def kernels(suite: str = "MT20-v2", device: str = "cuda:0", engine: str = "warp", processes: int | None = None) -> Json:
    """Compile the kernels of all classes of a suite with each of ``SWITCHES``, in parallel, into Warp's cache.

    Args:
        suite: Suite whose classes are built one by one.
        device: Device for which the kernels are compiled.
        engine: As in ``Benchmark.make_world``.
        processes: Number of processes that compile in parallel; None: one per core.

    Returns:
        Number of worlds to build (``jobs``), number of worlds that were ``built``, and ``seconds``.
    """
    begin = time.perf_counter()
    jobs = list(product(Benchmark(suite).train_classes, SWITCHES, [device], [engine]))
    count = min(len(jobs), processes or usable_cores())
    with ProcessPoolExecutor(count, multiprocessing.get_context("spawn")) as pool:
        built = sum(pool.map(_build, *zip(*jobs, strict=True)))
    return {"built": built, "jobs": len(jobs), "seconds": round(time.perf_counter() - begin, 1)}


def _build(name: str, switch: str, device: str, engine: str) -> bool:
    try:
        pixels = 64 if switch == "none" else 0  # the renderer's kernels too, once
        world = make_task_world(name, 8, device, engine=engine, pixels=pixels, **SWITCHES[switch])
        world.reset(seed=0)
        random_steps(world, 2)
        world.close()
    except (BidexError, RuntimeError, TypeError):
        return False  # ``switches`` reports the error
    return True

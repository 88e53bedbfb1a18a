"""Endurance: does the world, or a learner on it, stay as fast and as small as it was, and how often does it break?"""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bidex_meta.config import Steps
from bidex_meta.errors import BidexError
from bidex_meta.experiments.learners import LearnerKind, choose_preset, learner_kind
from bidex_meta.runs.atomic import write_json
from bidex_meta.utils.memory import usable_cores
from bidex_meta.world.contract import PooledWorld
from bidex_meta.world.wrapper import PooledWorldWrapper
from bidex_meta.worlds import Worlds
from tools.bench.drift import judge

_SAMPLE_SECONDS = 60.0
_FEWEST_SAMPLES = 20
_MINUTES = 60.0


class _Counting(PooledWorldWrapper):
    """Counts rows whose physics broke; on the device, so that nothing waits for the number."""

    def __init__(self, world: PooledWorld) -> None:
        super().__init__(world)
        self.steps = 0
        self.broken = torch.zeros((), dtype=torch.int64, device=world.device)

    def step(self, action: Tensor, /) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        result = super().step(action)
        self.steps += self.num_envs
        self.broken += result[-1]["unstable"].sum()
        return result


def soak(
    suite: str = "MT20",
    steps: Steps | None = None,
    minutes: float | None = None,
    num_envs: int = 512,
    threads: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    engine: str = "auto",
    out: Path | None = None,
    algo: str | None = None,
) -> dict[str, Any]:
    """Steps a suite's training world for long and takes a sample every minute (of a short soak, twenty in all).

    Args:
        suite: Suite to step.
        steps: Ends after so many environment steps, over all rows; None: only time ends it.
        minutes: Ends after so many; None: 60, or where ``steps`` are given, never.
        num_envs: Rows.
        threads: Engine threads; None takes all CPUs.
        seed: Seed of world, actions and learner.
        device: Where the world lives.
        engine: As in ``Benchmark.make_world``.
        out: File that takes each sample as it is taken, with what all of them say.
        algo: Learner that trains on the world; None: uniform random actions.

    Returns:
        ``table``, of each sample the environment steps per second of the wall and of this process's CPU time, resident
        memory (MB) and rows broken so far, per million steps too; ``memory_growth_percent`` after the warm-up, and for
        both speeds ``drift_percent`` from the end of the warm-up to the last sample, with its 95 % interval, and
        ``noise_percent``, the standard deviation of samples about that line; ``holds``, and ``verdict`` in words.

    Raises:
        BidexError: No time at all, or what ``Worlds.world`` refuses.
    """
    if minutes is not None and minutes <= 0:
        raise BidexError(f"--minutes must be more than 0, not {minutes:g}.")
    import scipy.stats  # noqa: F401  (judge takes it; imported after the first samples it would pass for a leak)

    minutes = _MINUTES if minutes is None and steps is None else minutes
    source = Worlds.open({"suite": suite, "seed": seed, "threads": threads, "device": device, "engine": engine})
    # The wrapper asks the world for what the protocol declares.
    kind, config = (None, None) if algo is None else chosen_learner(algo, device)
    mode = "SAME_STEP" if kind is None else kind.autoreset(vars(config))
    world = _Counting(source.world("train", num_envs, mode))  # pyright: ignore[reportAbstractUsage]
    act = _random(world, seed) if kind is None else kind.make(world, config, 0).iterate
    result: dict[str, Any] = {
        "suite": suite,
        "what": "random actions" if algo is None else "training",
        "num_envs": num_envs,
        "threads": threads or usable_cores(),
        "device": device,
        "table": [],
    }
    clock = _Clock(steps, minutes)
    while not clock.is_over(world.steps):
        act()
        if clock.is_due(world.steps) or clock.is_over(world.steps):
            result["table"].append(_sample(clock, world))
            print(_line(result["table"][-1]), file=sys.stderr, flush=True)
            # Each time, so that the file of a soak that is broken off has its verdict too.
            result |= judge(result["table"], "steps_per_s" if world.device.type == "cuda" else "steps_per_cpu_s")
            if out is not None:
                write_json(out, result)
    world.close()
    return result


def chosen_learner(algo: str, device: str) -> tuple[LearnerKind, Any]:
    """A learner, and the config that ``--preset auto`` gives it on a device."""
    kind = learner_kind(algo)
    return kind, kind.presets[choose_preset(kind, "auto", device)[0]]


class _Clock:
    """When to take a sample, and when to end."""

    def __init__(self, steps: int | None, minutes: float | None) -> None:
        self._most_steps, self._most_seconds = steps or sys.maxsize, 60.0 * (minutes or float("inf"))
        self._begun = time.perf_counter()
        self.taken(0)

    def taken(self, steps: int) -> tuple[float, float, float, int]:
        """Notes a sample; minutes since the begin, and since the last sample wall seconds, CPU seconds, steps."""
        now, cpu = time.perf_counter(), time.process_time()
        last = getattr(self, "_last", (now, cpu, 0))
        self._last = now, cpu, steps
        return (now - self._begun) / 60.0, now - last[0], cpu - last[1], steps - last[2]

    def is_due(self, steps: int) -> bool:
        seconds, done = time.perf_counter() - self._last[0], steps - self._last[2]
        most = min(_SAMPLE_SECONDS, self._most_seconds / _FEWEST_SAMPLES)
        return seconds >= most or done >= self._most_steps / _FEWEST_SAMPLES

    def is_over(self, steps: int) -> bool:
        return steps >= self._most_steps or time.perf_counter() - self._begun >= self._most_seconds


def _random(world: _Counting, seed: int) -> Callable[[], object]:
    world.reset(seed=seed)
    generator = torch.Generator(world.device).manual_seed(seed)
    shape = world.action_space.shape
    return lambda: world.step(2.0 * torch.rand(shape, generator=generator, device=world.device) - 1.0)


def _sample(clock: _Clock, world: _Counting) -> dict[str, Any]:
    broken = int(world.broken)
    since, wall, cpu, done = clock.taken(world.steps)
    memory = resident()
    sample = {
        "minute": round(since, 3),
        "env_steps": world.steps,
        "steps_per_s": round(done / wall, 1),
        "steps_per_cpu_s": round(done / max(cpu, 1e-9), 1),
        "memory_mb": None if memory is None else round(memory / 1e6, 2),
        "unstable": broken,
        "unstable_per_million": round(1e6 * broken / world.steps, 3),
    }
    if world.device.type == "cuda":
        sample["gpu_memory_mb"] = round(torch.cuda.memory_reserved(world.device) / 1e6, 2)
    return sample


def resident() -> int | None:
    """Bytes of memory that this process holds now; None where the system does not tell (beside Linux)."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError, IndexError):
        return None


def _line(sample: dict[str, Any]) -> str:
    return (
        f"{sample['minute']:7.1f} min {sample['env_steps']:>12,} steps  {sample['steps_per_s']:>9,.0f}/s  "
        f"{sample['steps_per_cpu_s']:>9,.0f}/CPU s  {sample['memory_mb']} MB  "
        f"{sample['unstable']} unstable ({sample['unstable_per_million']:g} per million)"
    )

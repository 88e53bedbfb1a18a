"""Measure an accelerator: speed by the number of environments, memory per environment, and time per stage of a step."""

import json
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import psutil
import torch

from bidex_meta.benchmark import Benchmark, make_task_world
from bidex_meta.errors import BidexError
from bidex_meta.experiments.learners import choose_preset, learner_kind
from bidex_meta.runs.atomic import Json, write_json
from bidex_meta.world import World

_SIZES = (1024, 8192, 32768, 131072)
_TASKS = ("CatchUnderarm", "BottleCap", "DoorOpenOutward")
"""A thrown egg, a jointed object and a movable fixture."""
_RECORDED = 32
"""Steps after which a world on CUDA replays all of its work: starts are drawn at every eighth, plainly at first."""


def gpu(
    suite: str = "MT20",
    tasks: Sequence[str] = _TASKS,
    sizes: Sequence[int] = _SIZES,
    steps: int = 20,
    device: str = "cuda:0",
    engine: str = "auto",
    seed: int = 0,
    out: Path | None = None,
    learning: bool = False,
    deterministic: bool = False,
    switches: str = "",
) -> Json:
    """Measure the speed of a suite and of single classes over the number of environments.

    Args:
        suite: Suite to step.
        tasks: Classes to step alone.
        sizes: Numbers of environments.
        steps: Control steps of each measurement, after as many to warm up, 32 at least.
        device: Where the worlds live.
        engine: As in ``Benchmark.make_world``.
        seed: Seed of worlds and actions.
        out: File that takes each row as it is measured; what is in it is not measured again.
        learning: Measure training with MT-PPO too.
        deterministic: As in ``Benchmark.make_world``.
        switches: As in ``Benchmark.make_world``.

    Returns:
        By subject and size: ``env_steps_per_s``, ``training_steps_per_s``, ``mb_per_env`` (device memory) and
        ``stages``, milliseconds of a step, of its physics, together and group by group, and of learning.
    """
    machine = "cpu" if device == "cpu" else torch.cuda.get_device_name(device)
    setting = {"device": device, "engine": engine, "steps": steps, "machine": machine}
    physics = {"deterministic": deterministic, "switches": switches}
    setting |= {name: value for name, value in physics.items() if value}
    rows = _known(out, setting)
    for subject in (suite, *tasks):
        for size in sizes:
            key = f"{subject} {size}"
            if key not in rows:
                rows[key] = _measured(subject, subject == suite, size, steps, device, engine, seed, learning, physics)
                if out is not None:
                    write_json(out, {"setting": setting, "rows": rows})
    return {"setting": setting, "rows": rows}


def _known(out: Path | None, setting: Json) -> Json:
    if out is None or not out.exists():
        return {}
    stored = json.loads(out.read_text())
    if stored["setting"] != setting:
        raise BidexError(f"Expected {out} to be measured with {setting}, got {stored['setting']}; name another file.")
    return stored["rows"]


def _measured(
    subject: str, whole: bool, size: int, steps: int, device: str, engine: str, seed: int, learning: bool,
    physics: Json
) -> Json:  # fmt: skip
    before = _memory(device)
    if whole:
        made = Benchmark(subject, seed=seed).make_world("train", num_envs=size, device=device, engine=engine, **physics)
    else:
        made = make_task_world(subject, num_envs=size, device=device, engine=engine, seed=seed, **physics)
    made.reset(seed=seed)
    _random_steps(made, max(steps, _RECORDED))
    seconds = _random_steps(made, steps)
    row: Json = {
        "env_steps_per_s": round(size * steps / seconds),
        "mb_per_env": round((_memory(device) - before) / size / 2**20, 3),
        "stages": _stages(made, steps),
    }
    if learning:
        kind = learner_kind("mtppo")
        learner = kind.make(made, kind.presets[choose_preset(kind, "auto", device)[0]], 0)
        for _ in range(5):  # its update is recorded as a graph after a few
            numbers = learner.iterate()
        row["training_steps_per_s"] = round(numbers["Perf/steps_per_second"])
        row["stages"]["learning"] = round(1000.0 * size / row["training_steps_per_s"] - row["stages"]["step"], 3)
    made.close()
    return row


def _stages(made: World, steps: int) -> dict[str, float]:
    """Return the milliseconds of a step, its physics, the rest (``torch``), and each group with the others at rest.

    ``launching`` is the host's part of the physics. ``overlap`` is 0 if groups run one after the other, and 1 if all
    groups together take no longer than the slowest group.
    """
    took = {"step": 1000.0 * _random_steps(made, steps) / steps}
    took["physics"], took["launching"] = _milliseconds(made, steps, made.step_engines)
    took["torch"] = took["step"] - took["physics"]
    alone = {}
    for part in made.parts:
        name = made.slots[part.group.members[0].slot].name
        alone[f"physics of {name} alone"] = _milliseconds(made, steps, partial(part.advance, None))[0]
    total, slowest = sum(alone.values()), max(alone.values())
    if len(alone) > 1:
        took |= alone | {"sum": total, "slowest": slowest, "overlap": (total - took["physics"]) / (total - slowest)}
    return {name: round(value, 3) for name, value in took.items()}


def _random_steps(world: World, steps: int) -> float:
    """Return the seconds that steps under uniform actions take; the actions are drawn before the clock starts."""
    generator = torch.Generator(world.device).manual_seed(0)
    shape = steps, world.num_envs, world.action_size
    actions = 2.0 * torch.rand(shape, generator=generator, device=world.device) - 1.0
    start = _now(world.device)
    for action in actions:
        world.step(action)
    return _now(world.device) - start


def _now(device: torch.device) -> float:
    """Return the clock's seconds after the device has finished all its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def _milliseconds(made: World, steps: int, work: Callable[[], None]) -> tuple[float, float]:
    """Return the mean milliseconds of a run of ``work`` until all is done, and until the host has launched it."""
    start = _now(made.device)
    for _ in range(steps):
        work()
    launched = time.perf_counter() - start
    return 1000.0 * (_now(made.device) - start) / steps, 1000.0 * launched / steps


def _memory(device: str) -> int:
    """Return the bytes in use: on a GPU those of all processes, else those of this process."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)
        torch.cuda.empty_cache()
        free, total = torch.cuda.mem_get_info(device)
        return total - free
    return psutil.Process().memory_info().rss

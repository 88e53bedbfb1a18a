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
"""Classes with a thrown egg, a jointed object and a movable fixture."""
RECORDED = 32
"""Number of steps after which a world on CUDA replays all of its work as CUDA graphs: initial states are drawn at every
eighth step, and work is recorded only after its first runs."""


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
    """Measure the speed of a suite and of single classes for several numbers of environments.

    Args:
        suite: Suite to step.
        tasks: Classes to step on their own.
        sizes: Numbers of environments.
        steps: Number of control steps of each measurement. The same number of steps, but at least 32, comes first, to
            warm up.
        device: Device of the worlds.
        engine: As in ``Benchmark.make_world``.
        seed: Seed of worlds and actions.
        out: File to which each row is written as it is measured; rows that are in the file are not measured again.
        learning: Also measure training with MT-PPO.
        deterministic: As in ``Benchmark.make_world``.
        switches: As in ``Benchmark.make_world``.

    Returns:
        ``rows`` by suite or class and size: ``env_steps_per_s``, ``training_steps_per_s``, ``mb_per_env`` (device
        memory) and ``stages``: milliseconds per step of the whole step, of the physics (of all groups together and of
        each group) and of learning.
    """
    setting = {"device": device, "engine": engine, "steps": steps, "machine": machine_of(device)}
    physics = {"deterministic": deterministic, "switches": switches}
    setting |= {name: value for name, value in physics.items() if value}
    rows = known_rows(out, setting)
    for subject in (suite, *tasks):
        for size in sizes:
            key = f"{subject} {size}"
            if key not in rows:
                rows[key] = _measured(subject, subject == suite, size, steps, device, engine, seed, learning, physics)
                if out is not None:
                    write_json(out, {"setting": setting, "rows": rows})
    return {"setting": setting, "rows": rows}


def machine_of(device: str) -> str:
    """Return the name of the GPU, or ``cpu``; raise BidexError if there is no such GPU."""
    if torch.device(device).type == "cpu":
        return "cpu"
    if not torch.cuda.is_available():
        raise BidexError(f"Expected a CUDA device for {device}, found none. Give --device cpu.")
    return torch.cuda.get_device_name(device)


def known_rows(out: Path | None, setting: Json) -> Json:
    """Return the rows of an earlier file of results; raise BidexError if they were measured with other settings."""
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
    random_steps(made, max(steps, RECORDED))
    seconds = random_steps(made, steps)
    row: Json = {
        "env_steps_per_s": round(size * steps / seconds),
        "mb_per_env": round((_memory(device) - before) / size / 2**20, 3),
        "stages": _stages(made, steps),
    }
    if learning:
        row["training_steps_per_s"] = training_speed(made, choose_preset(learner_kind("mtppo"), "auto", device)[0])
        row["stages"]["learning"] = round(1000.0 * size / row["training_steps_per_s"] - row["stages"]["step"], 3)
    made.close()
    return row


def training_speed(world: World, preset: str) -> int:
    """Return the environment steps per second of MT-PPO's fifth iteration, whose update is a recorded graph."""
    kind = learner_kind("mtppo")
    learner = kind.learner_class(world, kind.presets[preset], 0)
    numbers: dict[str, float] = {}
    for _ in range(5):
        numbers = learner.iterate()
    return round(numbers["Perf/steps_per_second"])


def _stages(made: World, steps: int) -> dict[str, float]:
    """Return the milliseconds of a step and of its parts, by name.

    ``physics`` is the physics of all groups together; ``torch`` is the rest of the step. The physics of each group is
    also measured while no other group runs. ``launching`` is the time that the host spends in the physics. ``overlap``
    is 0 if groups run one after the other, and 1 if all groups together take no longer than the slowest group.
    """
    took = {"step": 1000.0 * random_steps(made, steps) / steps}
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


def random_steps(world: World, steps: int) -> float:
    """Return the seconds that steps under uniform actions take; the actions are drawn before the clock starts."""
    generator = torch.Generator(world.device).manual_seed(0)
    shape = steps, world.num_envs, world.action_size
    actions = 2.0 * torch.rand(shape, generator=generator, device=world.device) - 1.0
    start = now(world.device)
    for action in actions:
        world.step(action)
    return now(world.device) - start


def now(device: torch.device) -> float:
    """Wait until the device has finished all its work, and return the time in seconds."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def _milliseconds(made: World, steps: int, work: Callable[[], None]) -> tuple[float, float]:
    """Return two mean times per call of ``work``, in milliseconds.

    The first time lasts until the device has finished its work, the second until the call returns.
    """
    start = now(made.device)
    for _ in range(steps):
        work()
    launched = time.perf_counter() - start
    return 1000.0 * (now(made.device) - start) / steps, 1000.0 * launched / steps


def _memory(device: str) -> int:
    """Return the bytes in use: on a GPU the bytes of all processes, otherwise the bytes of this process."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)
        torch.cuda.empty_cache()
        free, total = torch.cuda.mem_get_info(device)
        return total - free
    return psutil.Process().memory_info().rss

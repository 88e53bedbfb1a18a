"""``bench field``: compare the speed of our worlds with other libraries, side by side on one core."""

import importlib
import math
import statistics
import time
from collections.abc import Iterator
from itertools import chain
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv

from bidex_meta.benchmark import Benchmark
from bidex_meta.metaworld.batched import MetaWorldWorld
from bidex_meta.rules import CONTROL_RATE
from bidex_meta.runs.atomic import Json
from bidex_meta.utils.memory import usable_cores

_METAWORLD_ROWS = 10
_HANDS = ("HandReach-v3", "HandManipulateEgg-v1")
"""Environments of gymnasium-robotics: one Shadow Hand with 20 actions, without an object and with an egg."""
_HAND_ROWS = 4
_SUITES = ("MT4", "MT20")
_INSTALL = "pip install gymnasium-robotics"


def field(num_envs: int = 1024, steps: int = 10_000, repeats: int = 7, seed: int = 0) -> Json:
    """Measure speed under random actions with resets: Meta-World's MT10, gymnasium-robotics' hand, our MT4 and MT20.

    Everything runs in one process on one thread; pin the process to a core (``taskset -c 0``). Tasks and the duration
    of a step differ between the libraries, so the table has further columns besides the speed.

    Args:
        num_envs: Number of environments of MT4 and MT20. Both worlds of Meta-World have ten.
        steps: Number of environment steps of each repeat. One more repeat comes first, to warm up.
        repeats: Number of interleaved repeats; medians are reported.
        seed: Seed of environments and actions.

    Returns:
        ``cpus`` (number that the process may use), ``skipped`` (libraries that are missing and how to install them) and
        ``table``. A row has the number of environments (``rows``), the number of actions, the smallest and largest
        number of degrees of freedom of a model, simulated seconds per step, ``env_steps_per_s``, environment steps per
        CPU second (which other work on the core affects less), simulated seconds per second, and ``ratio``: the speed
        relative to Meta-World's own vector environment.
    """
    rng = np.random.default_rng(seed)
    skipped = {}
    entries = [*_metaworld(seed), *_robot_hands(skipped), *_ours(num_envs, seed)]
    for _, vector, _, _ in entries:
        vector.reset(seed=seed)
    speeds: list[list[Speed]] = [[] for _ in entries]
    for repeat in range(repeats + 1):
        for (_, vector, _, _), found in zip(entries, speeds, strict=True):
            speed = _speed(vector, steps, rng)
            if repeat:  # the first repeat warms up
                found.append(speed)
    table = [_row(entry, found, speeds[0]) for entry, found in zip(entries, speeds, strict=True)]
    for _, vector, _, _ in entries:
        vector.close()
    return {"cpus": usable_cores(), "skipped": skipped, "table": table}


Entry = tuple[str, VectorEnv, float, list[int]]
"""Name, environment, simulated seconds per step, and degrees of freedom of each model of the environment."""
Speed = tuple[float, float]
"""Environment steps per second of wall time, and per second of the process's CPU time."""


def _metaworld(seed: int) -> Iterator[Entry]:
    ours = MetaWorldWorld("metaworld/MT10", _METAWORLD_ROWS, seed=seed)  # the import corrects Meta-World for both
    theirs: Any = gymnasium.make_vec("Meta-World/MT10", vector_strategy="sync", seed=seed)
    singles = [env.unwrapped for env in theirs.envs]
    dofs = [single.model.nv for single in singles]
    yield "Meta-World MT10, its vector environment", theirs, singles[0].dt, dofs
    yield "Meta-World MT10, through ours", ours, singles[0].dt, dofs


def _robot_hands(skipped: dict[str, str]) -> Iterator[Entry]:
    try:
        robotics = importlib.import_module("gymnasium_robotics")
    except ModuleNotFoundError as error:
        skipped["gymnasium-robotics"] = f"{error.name} is not installed: {_INSTALL}"
        return
    _mend(importlib.import_module("gymnasium_robotics.utils.mujoco_utils"))
    gymnasium.register_envs(robotics)
    for name in _HANDS:
        vector: Any = gymnasium.make_vec(name, num_envs=_HAND_ROWS, vectorization_mode="sync")
        single = vector.envs[0].unwrapped
        yield f"gymnasium-robotics {name}", vector, single.dt, [single.model.nv]


def _mend(utils: Any) -> None:
    """Patch gymnasium-robotics 1.4.2 to run on MuJoCo 3.12 and later.

    gymnasium-robotics tests if a joint's type, a NumPy number, is in a tuple of members of MuJoCo's enum of types.
    Since MuJoCo 3.12 these members no longer equal NumPy numbers, so no hand can be made. The patch replaces the
    members by plain numbers in the library's module.
    """
    mujoco = utils.mujoco
    plain = SimpleNamespace(**{name: int(kind) for name, kind in mujoco.mjtJoint.__members__.items()})
    utils.mujoco = SimpleNamespace(**{**vars(mujoco), "mjtJoint": plain})


def _ours(num_envs: int, seed: int) -> Iterator[Entry]:
    for suite in _SUITES:
        made = Benchmark(suite, seed=seed).make_world("train", device="cpu", num_envs=num_envs, threads=1)
        members = chain.from_iterable(part.group.members for part in made.parts)
        yield f"bidex-meta {suite}", made, 1.0 / CONTROL_RATE, [member.scene.model.nv for member in members]


def _speed(vector: VectorEnv, steps: int, rng: np.random.Generator) -> Speed:
    """Measure how fast a vector environment steps uniform actions."""
    shape = math.ceil(steps / vector.num_envs), vector.num_envs, *(vector.single_action_space.shape or ())
    actions = rng.uniform(-1.0, 1.0, shape).astype(np.float32)
    wall = time.perf_counter()
    cpu = time.process_time()
    for action in actions:
        vector.step(action)
    done = shape[0] * shape[1]
    return done / (time.perf_counter() - wall), done / (time.process_time() - cpu)


def _row(entry: Entry, speeds: list[Speed], first: list[Speed]) -> Json:
    name, vector, seconds, dofs = entry
    least, most = min(dofs), max(dofs)
    wall, cpu = (statistics.median(column) for column in zip(*speeds, strict=True))
    return {
        "what": name,
        "rows": vector.num_envs,
        "actions": math.prod(vector.single_action_space.shape or ()),
        "dofs": str(least) if least == most else f"{least}-{most}",
        "physics_s_per_step": round(seconds, 4),
        "env_steps_per_s": round(wall),
        "env_steps_per_cpu_s": round(cpu),
        "physics_s_per_s": round(wall * seconds, 1),
        "ratio": round(statistics.median(a / b for (a, _), (b, _) in zip(speeds, first, strict=True)), 3),
    }

"""Ways to break a row by hand. ``python -m tests.world.breaking [CLASS ...]`` measures what a step with one costs."""

import math
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import torch

from bidex_meta.engine.cpu import CpuEngine
from bidex_meta.tasks import registry
from tests.tasks.worlds import engine_of
from tests.world.play import class_world, random_actions

ROW = 0
"""The row that is broken."""


def _write(name: str, value: float, place: Any = slice(None)) -> Callable[[CpuEngine], None]:
    def write(engine: CpuEngine) -> None:
        engine._state[name][(ROW, *place) if isinstance(place, tuple) else (ROW, place)] = value

    return write


def _flatten_rotation(engine: CpuEngine) -> None:
    engine._numbers[ROW, engine._quaternions[:4]] = 0.0


BEFORE: dict[str, Callable[[CpuEngine], None]] = {
    "NaN position": _write("qpos", math.nan, 3),
    "infinite last position": _write("qpos", math.inf, -1),
    "position of 1e7": _write("qpos", 1e7, 10),
    "NaN velocity": _write("qvel", math.nan, 3),
    "velocity of 1e9": _write("qvel", 1e9, 7),
    "NaN warm start": _write("qacc_warmstart", math.nan),
    "NaN force": _write("xfrc_applied", math.nan, (-1, 0)),
    "infinite joint force": _write("qfrc_applied", math.inf, 5),
    "NaN control": _write("ctrl", math.nan, 2),
    "quaternion of length zero": _flatten_rotation,
}
"""What is found before the step."""
TIME: dict[str, Callable[[CpuEngine], None]] = {
    "NaN time": lambda engine: engine._state["time"].__setitem__(ROW, math.nan),
    "infinite time": lambda engine: engine._state["time"].__setitem__(ROW, -math.inf),
}
FIXTURE: dict[str, Callable[[CpuEngine], None]] = {
    "NaN fixture": _write("mocap_pos", math.nan),
    "fixture's quaternion of length zero": _write("mocap_quat", 0.0),
}
WITHIN: dict[str, Callable[[CpuEngine], None]] = {
    "all velocities 1e5": _write("qvel", 1e5),
    "all velocities 9e5": _write("qvel", 9e5),
    "force of 1e9 N": _write("xfrc_applied", 1e9, (slice(None), 0)),
}
"""Within bounds, and broken by the step itself; slower classes survive some of it."""


def ways(engine: CpuEngine) -> dict[str, Callable[[CpuEngine], None]]:
    """What can be broken in an engine's rows and is found before the step."""
    return BEFORE | TIME | (FIXTURE if "mocap_pos" in engine._state else {})


def measure(name: str) -> dict[str, float]:
    """CPU seconds of a normal step of two rows, and multiples of it that steps with a row broken so took."""
    world = class_world(name, 2)
    actions = random_actions(world, 30)

    def step(i: int) -> float:
        begun = time.process_time()
        world.step(actions[i])
        return time.process_time() - begun

    world.reset(seed=0)
    normal = statistics.median([step(i) for i in range(30)][5:])
    found = {"normal": normal}
    measured = ("NaN position", "NaN velocity", "NaN warm start", "NaN force", "velocity of 1e9", *WITHIN)
    for kind, spoil in ((kind, (BEFORE | WITHIN)[kind]) for kind in measured):
        world.reset(seed=1)
        step(0)
        spoil(engine_of(world))
        found[kind] = step(1) / normal
    return found


if __name__ == "__main__":
    torch.set_num_threads(1)
    for each in sys.argv[1:] or registry.names():
        ratios = measure(each)
        told = ", ".join(f"{kind} {value:.1f}" for kind, value in ratios.items() if kind != "normal")
        print(f"{each}: {1000 * ratios['normal']:.2f} ms; {told}", flush=True)

"""Measure how fast mujoco_warp's renderer draws the environments of a suite."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path

from bidex_meta.benchmark import Benchmark
from bidex_meta.runs.atomic import Json, write_json
from bidex_meta.world.rendering import Painter
from tools.bench.gpu import known_rows, machine_of, now, random_steps


def pictures(
    suites: Sequence[str] = ("MT20-v2", "ML20-v2"),
    edges: Sequence[int] = (64, 84),
    num_envs: int = 2048,
    steps: int = 10,
    device: str = "cuda:0",
    engine: str = "warp",
    seed: int = 0,
    out: Path | None = None,
) -> Json:
    """Measure pictures per second, and steps per second if each step draws every environment.

    Args:
        suites: Suites to draw. If a suite shows its goals, each environment is drawn twice.
        edges: Edge lengths of the square pictures, pixels.
        num_envs: Number of environments, all of which are drawn.
        steps: Number of pictures per environment, and number of control steps; one more of each warms up.
        device: Device of the worlds.
        engine: As in ``Benchmark.make_world``; ``c`` draws with MuJoCo.
        seed: Seed of worlds and actions.
        out: File to which each row is written as it is measured; rows that are in the file are not measured again.

    Returns:
        ``setting``, and ``rows`` by suite and edge.
    """
    setting = {"device": device, "engine": engine, "num_envs": num_envs, "steps": steps, "machine": machine_of(device)}
    rows = known_rows(out, setting)
    for suite, edge in product(suites, edges):
        key = f"{suite} {edge}"
        if key in rows:
            continue
        world = Benchmark(suite, seed=seed).make_world(
            "train", num_envs=num_envs, device=device, engine=engine, pixels=edge
        )
        world.reset(seed=seed)
        random_steps(world, 1)
        stepping = random_steps(world, steps)
        painter = Painter()
        painter.pictures(world, edge)
        begin = now(world.device)
        for _ in range(steps):
            painter.pictures(world, edge)
        drawing = now(world.device) - begin
        rows[key] = {
            "suite": suite,
            "pixels": edge,
            "goals": "hidden" if world.hides_goals else "shown",
            "pictures_per_s": round(num_envs * steps / drawing),
            "env_steps_per_s": round(num_envs * steps / stepping),
        }
        painter.close()
        world.close()
        if out is not None:
            write_json(out, {"setting": setting, "rows": rows})
    return {"setting": setting, "rows": rows}

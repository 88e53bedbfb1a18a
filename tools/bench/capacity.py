"""Measure how many contacts and constraint rows the classes need; ``TaskClass.needs`` holds the measured numbers."""

import math

import torch
from torch import Tensor

from bidex_meta.benchmark import make_task_world
from bidex_meta.engine.cpu import CpuEngine
from bidex_meta.runs.atomic import Json
from bidex_meta.world import World
from tools.bench.stability import rough_actions, variants

_QUANTILES = {"median": 0.5, "q999": 0.999, "q9999": 0.9999, "max": 1.0}
_SAMPLES_PER_STEP = 32


def capacity(
    suite: str | None = None,
    task: str | None = None,
    steps: int = 200_000,
    num_envs: int = 256,
    threads: int | None = None,
    seed: int = 0,
) -> Json:
    """Count the contacts and constraint rows of each class under rough actions (``stability.rough_actions``).

    C MuJoCo counts contacts and constraint rows after every step of every environment. mujoco_warp counts candidate
    pairs of the broadphase and pairs of the convex collider in a sample of 32 environments per step.

    Args:
        suite: Measure the classes of this suite.
        task: Measure this class; with neither suite nor task every class is measured.
        steps: Number of environment steps per class.
        num_envs: Number of environments.
        threads: Engine threads; None: one per CPU.
        seed: Seed of world and actions.

    Returns:
        Quantiles over environments and steps, by class: contacts, constraint rows, candidate pairs and convex pairs.
    """
    result = {}
    for name, moving in variants(suite, task):
        made = make_task_world(
            name, num_envs, "cpu", seed=seed, autoreset_mode="DISABLED", threads=threads, moving_base=moving
        )
        result[name if moving else f"{name} (fixed base)"] = _capacity(made, steps, seed)
    return result


def _capacity(made: World, steps: int, seed: int) -> Json:
    from bidex_meta.engine.capacity import Capacity
    from bidex_meta.engine.warp import WarpEngine

    generator = torch.Generator().manual_seed(seed)
    made.reset(seed=seed)
    engine = made.parts[0].group.engine
    assert isinstance(engine, CpuEngine)
    probe = WarpEngine([engine.model(0)], [0], capacity=Capacity(contacts=2048, convex=512, rows=2048))
    fields = {"contacts": "ncon", "rows": "nefc"}
    counts = {name: torch.from_numpy(engine.batch.bind(field)) for name, field in fields.items()}
    found: dict[str, list[Tensor]] = {name: [] for name in (*counts, "candidates", "convex")}
    held, left = torch.zeros(made.num_envs, made.action_size), torch.zeros(made.num_envs, dtype=torch.int64)
    for _ in range(math.ceil(steps / made.num_envs)):
        info = made.step(rough_actions(held, left, generator))[-1]
        for name, count in counts.items():
            found[name].append(count.flatten().clone())
        for row in torch.randint(made.num_envs, (_SAMPLES_PER_STEP,), generator=generator).tolist():
            probe.reset(torch.tensor([True]), engine.placement()[row : row + 1])
            candidates, convex = probe.demand()
            found["candidates"].append(torch.tensor([candidates]))
            found["convex"].append(torch.tensor([convex]))
        if info["_final_obs"].any():
            made.reset(options={"reset_mask": info["_final_obs"]})
    return {name: _summary(torch.cat(values)) for name, values in found.items()}


def _summary(counts: Tensor) -> Json:
    # torch.quantile accepts at most 16 million numbers, so we sort.
    ordered = counts.sort().values
    last = len(ordered) - 1
    return {"samples": len(ordered)} | {n: int(ordered[math.ceil(q * last)]) for n, q in _QUANTILES.items()}

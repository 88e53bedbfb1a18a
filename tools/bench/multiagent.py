"""The training speed of learners of several agents beside MT-PPO's: physics, rollouts and update, in one process."""

import statistics
import time
from dataclasses import replace
from typing import Any

import torch

from bidex_algos.multiagent import happo, hatrpo, ippo, mappo
from bidex_algos.onpolicy import mtppo
from bidex_algos.onpolicy.base import OnPolicy
from bidex_meta.benchmark import make_task_world
from bidex_meta.world.contract import VectorWorld
from bidex_meta.world.threads import set_up_torch

_LEARNERS: dict[str, tuple[Any, dict[str, Any]]] = {
    "happo": (happo.HAPPO, happo.PRESETS),
    "mappo": (mappo.MAPPO, mappo.PRESETS),
    "ippo": (ippo.IPPO, ippo.PRESETS),
    "hatrpo": (hatrpo.HATRPO, hatrpo.PRESETS),
}
_PARTITIONS = ("hands", "fingers")


def multiagent(
    task: str = "CatchUnderarm",
    num_envs: int = 1024,
    repeats: int = 7,
    threads: int = 1,
    seed: int = 0,
    preset: str = "laptop",
) -> dict[str, Any]:
    """Training steps a CPU second of HAPPO, MAPPO, IPPO and HATRPO, with two and with twelve agents, over MT-PPO's.

    All take whole iterations in turns on one world, each from where the one before it stopped, so that they meet the
    same physics. CPU seconds are the process's: other work on the machine sways them less than the clock.

    Args:
        task: The class.
        num_envs: Rows.
        repeats: Iterations of each learner that count, after one to warm up.
        threads: Threads of torch and of the physics.
        seed: Of world and learners.
        preset: Of all learners.

    Returns:
        The setting, and ``table``: for each learner the median of its training ``steps_per_cpu_s``, of the CPU seconds
        of an iteration and of its update alone, and the median ``ratio`` of MT-PPO's iteration over the learner's
        beside it (1: as fast; more: faster), with the least and the most.
    """
    before = torch.get_num_threads()
    world = make_task_world(task, num_envs, device="cpu", seed=seed, autoreset_mode="SAME_STEP", threads=threads)
    try:
        set_up_torch(threads)
        learners = _learners(world, preset, seed)
        times = _in_turns(world, list(learners.values()), repeats, seed)
        used = torch.get_num_threads()
    finally:
        world.close()
        torch.set_num_threads(before)
    steps = num_envs * mtppo.PRESETS[preset].rollout_steps
    table = [_row(name, taken, times[0], steps) for name, taken in zip(learners, times, strict=True)]
    return {"task": task, "num_envs": num_envs, "preset": preset, "threads": used, "repeats": repeats, "table": table}


def _learners(world: VectorWorld, preset: str, seed: int) -> dict[str, OnPolicy]:
    """MT-PPO first, then the others with each partition, all with rollouts of one length."""
    first = mtppo.MTPPO(world, mtppo.PRESETS[preset], seed)
    found: dict[str, OnPolicy] = {"mtppo": first}
    for partition in _PARTITIONS:
        for name, (make, presets) in _LEARNERS.items():
            config = replace(presets[preset], agents=partition, rollout_steps=first.config.rollout_steps)
            found[f"{name}, {partition}"] = make(world, config, seed)
    return found


def _in_turns(world: VectorWorld, learners: list[OnPolicy], repeats: int, seed: int) -> list[list[tuple[float, float]]]:
    """CPU seconds of each learner's iterations, and of their updates."""
    taken: list[list[tuple[float, float]]] = [[] for _ in learners]
    updates = [_timed(learner) for learner in learners]
    obs, _ = world.reset(seed=seed)
    for repeat in range(repeats + 1):
        # Who follows whom changes, so that no one always finds its neighbour's caches.
        order = range(len(learners)) if repeat % 2 else reversed(range(len(learners)))
        for i in order:
            learners[i].obs, start = obs, time.process_time()
            learners[i].iterate()
            if repeat:  # the first one warms up
                taken[i].append((time.process_time() - start, updates[i][-1]))
            obs = learners[i].obs
    return taken


def _timed(learner: Any) -> list[float]:
    """Puts a clock around a learner's update, which is no metric; the CPU seconds of each."""
    update, seconds = learner._update, list[float]()

    def timed(batch: Any) -> Any:
        start = time.process_time()
        losses = update(batch)
        seconds.append(time.process_time() - start)
        return losses

    learner._update = timed
    return seconds


def _row(name: str, taken: list[tuple[float, float]], beside: list[tuple[float, float]], steps: int) -> dict[str, Any]:
    whole, update = (statistics.median(each) for each in zip(*taken, strict=True))
    ratios = [theirs / own for (own, _), (theirs, _) in zip(taken, beside, strict=True)]
    return {
        "learner": name,
        "steps_per_cpu_s": round(steps / whole),
        "cpu_s": round(whole, 3),
        "update_cpu_s": round(update, 3),
        "ratio": round(statistics.median(ratios), 3),
        "least": round(min(ratios), 3),
        "most": round(max(ratios), 3),
    }

"""Test if the physics is stable under rough actions."""

import math

import torch
from torch import Tensor

from bidex_meta.benchmark import Benchmark, make_task_world
from bidex_meta.rules import V2
from bidex_meta.runs.atomic import Json
from bidex_meta.tasks import registry
from bidex_meta.witness.replay import replay
from bidex_meta.witness.store import load_witness, witness_path
from bidex_meta.world import World

MAX_OBJECT_SPEED = 20.0
"""Upper bound of the speed of objects, m/s."""
SHALLOW, DEEP = 0.005, 0.015
"""Depths of contacts, metres: few states may exceed the first one, and hardly any may exceed the second one."""
LEAST_SHALLOW, LEAST_NOT_DEEP, LEAST_SHALLOW_AT_WORK = 0.985, 0.998, 0.999
"""Minimum shares of states without a contact deeper than SHALLOW and DEEP under rough actions, and of states without a
contact deeper than SHALLOW while a witness is played."""
_SAMPLES_PER_STEP = 8


def stability(
    suite: str | None = None,
    task: str | None = None,
    steps: int = 1_000_000,
    num_envs: int = 512,
    threads: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    engine: str = "auto",
) -> Json:
    """Test whether the physics is stable under rough actions, and under actions that solve the task.

    Half the environments draw uniform actions at every step; the other half hold each action at -1 or 1 for 5 to 40
    steps. Depths of contacts are taken from a sample of environments. Then the class's witness (a stored episode that
    solves a task), if there is one, is played from its own start and from shifted starts.

    Args:
        suite: Test the classes of this suite, with the suite's bases and the rules of its version.
        task: Test this class with a moving base, and also with a fixed base if that is the class's default. With
            neither suite nor task every class is tested.
        steps: Number of environment steps per class.
        num_envs: Number of environments.
        threads: Engine threads; None: one per CPU.
        seed: Seed of world and actions.
        device: Device of the world.
        engine: As in ``Benchmark.make_world``.

    Returns:
        By class: number of unstable environment steps; number of warnings; speed of the fastest object (m/s); the share
        of sampled states without a contact deeper than 5 mm, and the share without one deeper than 15 mm; the 99.9 %
        quantile of depth (m); the share of the witness's states without a contact deeper than 5 mm (None if there is no
        witness or the base is fixed); and whether all limits hold.
    """
    result = {}
    for name, moving in variants(suite, task):
        # Environments whose episode ends are reset here, so that the last step of the episode is measured too.
        where = {"device": device, "engine": engine, "threads": threads}
        made = make_task_world(name, num_envs, seed=seed, autoreset_mode="DISABLED", moving_base=moving, **where)
        rough = _stability(made, steps, seed)
        made.close()
        at_work = witness_share(name, threads) if moving else None
        holds = rough.pop("holds") and (at_work is None or at_work >= LEAST_SHALLOW_AT_WORK)
        result[name if moving else f"{name} (fixed base)"] = rough | {"witness_below_5mm": at_work, "holds": holds}
    return result


def variants(suite: str | None, task: str | None) -> list[tuple[str, bool]]:
    """Return the names of the classes to test, each with a flag that is true if the base moves."""
    if suite is not None and task is None:
        benchmark = Benchmark(suite)
        classes = benchmark.task_classes("train") | benchmark.task_classes("test")
        version = {name: "-v2" if task_class.rules == V2 else "" for name, task_class in classes.items()}
        return [(name + version[name], task_class.moving_base) for name, task_class in classes.items()]
    found = []
    for name in [task] if task else registry.names():
        found.append((name, True))
        if not registry.get(name).moving_base:
            found.append((name, False))
    return found


def _stability(made: World, steps: int, seed: int) -> Json:
    generator = torch.Generator().manual_seed(seed)
    made.reset(seed=seed)
    engine = made.parts[0].group.engine
    sensors = made.parts[0].group.members[0].scene.sensors
    velocities = [where for name, where in sensors.items() if name.endswith("/linear_velocity")]
    held, left = torch.zeros(made.num_envs, made.action_size), torch.zeros(made.num_envs, dtype=torch.int64)
    unstable = warnings = 0
    fastest, depths = 0.0, []
    control_steps = math.ceil(steps / made.num_envs)
    for _ in range(control_steps):
        info = made.step(rough_actions(held, left, generator))[-1]
        unstable += int(info["unstable"].sum())
        warnings += int(engine.warnings().sum())
        fastest = max(fastest, max(float(engine.sensordata[:, w].norm(dim=1).max()) for w in velocities))
        sample = torch.randint(made.num_envs, (_SAMPLES_PER_STEP,), generator=generator).tolist()
        depths += [engine.contact_depth(row) for row in sample]
        if info["_final_obs"].any():
            made.reset(options={"reset_mask": info["_final_obs"]})
    depth = torch.tensor(depths)
    shallow, not_deep = (float((depth <= limit).double().mean()) for limit in (SHALLOW, DEEP))
    not_too_deep = shallow >= LEAST_SHALLOW and not_deep >= LEAST_NOT_DEEP
    return {
        "env_steps": made.num_envs * control_steps,
        "unstable": unstable,
        "warnings": warnings,
        "fastest_object": round(fastest, 2),
        "depth_samples": len(depths),
        "share_below_5mm": round(shallow, 5),
        "share_below_15mm": round(not_deep, 5),
        "depth_q999": round(float(depth.quantile(0.999)), 5),
        "holds": unstable == warnings == 0 and fastest <= MAX_OBJECT_SPEED and not_too_deep,
    }


def witness_share(name: str, threads: int | None = None) -> float | None:
    """Return the share of states without a contact deeper than 5 mm while a class's witness is replayed.

    A witness is a stored episode that solves a task; without one the result is None. Every state of the replayed
    episodes counts, from the witness's own start and from the shifted starts.
    """
    if not witness_path(name).is_file():
        return None
    depths = replay(name, load_witness(name), threads).depths
    return round(float((depths <= SHALLOW).double().mean()), 5)


def rough_actions(held: Tensor, left: Tensor, generator: torch.Generator) -> Tensor:
    """Return rough actions: uniform in the first half of the rows, and held at -1 or 1 in the second half.

    The held actions (``held``) and the steps for which they are still held (``left``) are updated in place.
    """
    num, size = held.shape
    half = num // 2
    expired = left <= 0
    held[expired] = torch.randint(2, (int(expired.sum()), size), generator=generator).float() * 2.0 - 1.0
    left[expired] = torch.randint(5, 41, (int(expired.sum()),), generator=generator)
    left -= 1
    action = held.clone()
    action[:half] = 2.0 * torch.rand(half, size, generator=generator) - 1.0
    return action

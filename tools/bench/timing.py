"""How long a world takes for random steps."""

import time
from typing import NamedTuple

import torch

from bidex_meta.world import World


class Seconds(NamedTuple):
    """What some work took."""

    wall: float
    """By the clock."""
    cpu: float
    """Of all threads of this process, which other work on the machine disturbs less."""


def random_steps(world: World, steps: int, seed: int = 0) -> Seconds:
    """Steps a world under uniform actions, which are drawn before the clock starts."""
    generator = torch.Generator(world.device).manual_seed(seed)
    shape = steps, world.num_envs, world.action_size
    actions = 2.0 * torch.rand(shape, generator=generator, device=world.device) - 1.0
    wall, cpu = now(world.device), time.process_time()
    for action in actions:
        world.step(action)
    return Seconds(now(world.device) - wall, time.process_time() - cpu)


def now(device: torch.device) -> float:
    """Seconds, once all that a device was given is done."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()

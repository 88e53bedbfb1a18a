"""The replay of an off-policy learner, as large as its memory allows."""

import sys

import torch

from bidex_algos.experience.replay import Replay, replay_bytes, steps_within
from bidex_algos.offpolicy.config import OffPolicyConfig
from bidex_meta.errors import BidexError
from bidex_meta.train.distributed import is_main
from bidex_meta.world.contract import VectorWorld


def replay_within(learner: str, world: VectorWorld, config: OffPolicyConfig, observations: int, actions: int) -> Replay:
    """The replay that was asked for, or as much of it as its memory holds.

    Raises:
        BidexError: A task has no rows, or not one vector step fits.
    """
    rows, asked, share = world.num_envs, config.replay_steps, config.cut_share
    present = torch.bincount(world.task_id, minlength=world.num_tasks).tolist()
    if 0 in present:
        raise BidexError(f"{learner}: task {world.task_names[present.index(0)]} has no rows. Raise num_envs.")
    steps = steps_within(config.replay_memory * 1e9, asked, rows, observations, actions, share)
    needed = replay_bytes(asked, rows, observations, actions, share) / 1e9
    if steps == 0:
        raise BidexError(
            f"{learner}: replay_memory {config.replay_memory:g} GB holds not one step of {rows} rows. Raise it."
        )
    if steps < asked and is_main():
        print(
            f"{learner}: a replay of {asked:,} vector steps ({asked * rows:,} transitions) needs {needed:.1f} GB; "
            f"replay_memory is {config.replay_memory:g} GB: it keeps {steps:,} ({steps * rows:,} transitions).",
            file=sys.stderr,
            flush=True,
        )
    return Replay(steps, world.task_id, world.num_tasks, observations, actions, world.device, share)

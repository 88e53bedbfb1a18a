"""Division of a world's tasks into portions of equal size that fit in its environments, for the meta-test.

Each adaptation (a trial of a task) takes one environment per rollout. The last portion is filled up with the first
adaptations, which are played once more and not counted, so that every portion groups the environments in the same way.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.play import Episodes, joined_episodes
from bidex_meta.world.contract import PooledWorld, TaskWorld


def task_of_row(world: TaskWorld) -> Tensor:
    """Return the number of each environment's task, int64 ``(num_envs,)``.

    The tasks of all classes are numbered consecutively, in the order of the classes.
    """
    before = torch.tensor([0, *world.num_slot_tasks[:-1]], device=world.task_id.device).cumsum(0)
    return world.task_index + before[world.task_id]


class Portions:
    """Division of a meta-test into portions, groups of tasks that are played together.

    Each task is adapted to once in each of ``trials`` trials. ``tasks`` limits the test to the first tasks of each
    class's pool; None stands for all tasks. ``rollouts`` is the number of exploring episodes of a task in a shot. If it
    is None, as many tasks as possible are played at once, and each environment of a task plays one episode. All numbers
    are at least 1. The constructor does not change the world.
    """

    def __init__(self, world: TaskWorld, rollouts: int | None, tasks: int | None, trials: int) -> None:
        self._pool_sizes = list(world.num_slot_tasks)
        self._adaptations: list[np.ndarray] = []
        """For each slot, the task of each of its adaptations."""
        for size in self._pool_sizes:
            played = np.arange(min(tasks or size, size))
            self._adaptations.append(np.tile(played, trials))
        envs = [env_ids.stop - env_ids.start for env_ids in world.slot_env_ids]
        counts = []
        for num_envs, adaptations in zip(envs, self._adaptations, strict=True):
            at_once = max(1, num_envs // (rollouts or 1))
            counts.append(_divided_up(len(adaptations), at_once))
        self.count = max(counts)
        """Number of portions; the slot that needs most of them decides."""
        self._sizes = [_divided_up(len(adaptations), self.count) for adaptations in self._adaptations]
        most = min(num_envs // size for num_envs, size in zip(envs, self._sizes, strict=True))
        self.rollouts = rollouts or most

    @contextmanager
    def applied_to(self, worlds: Sequence[TaskWorld]) -> Iterator[Iterator[int]]:
        """Provide, for a ``with`` block, an iterator over the numbers of the portions.

        Each step of the iterator gives all worlds the tasks of the next portion. When the block ends, all worlds get
        their original pools of tasks back. Raises BidexError for a world whose tasks cannot be set, or whose pools
        differ in length from those of the constructor's world.
        """
        for world in worlds:
            if list(world.num_slot_tasks) != self._pool_sizes:
                raise BidexError(
                    f"Expected adapt_world with {self._pool_sizes} tasks in its pools, as world has, got "
                    f"{list(world.num_slot_tasks)}. Call set_tasks with the same number of tasks."
                )
        if self.count == 1 and [len(adaptations) for adaptations in self._adaptations] == self._pool_sizes:
            yield iter(range(1))  # the world keeps its own pools
            return
        pooled = [world for world in worlds if isinstance(world, PooledWorld)]
        for world in worlds:
            if not isinstance(world, PooledWorld):
                raise BidexError(
                    f"Expected num_envs of tasks times rollouts from a {type(world).__name__}, whose tasks cannot be "
                    f"set; it has {world.num_envs}. Raise num_envs, or leave out tasks, trials and rollouts."
                )
        pools = [world.pools for world in pooled]
        try:
            yield self._set(pooled, pools)
        finally:
            for world, own in zip(pooled, pools, strict=True):
                world.set_tasks(dict(zip(world.task_names, own, strict=True)))

    def labelled(self, episodes: Episodes, portion: int) -> Episodes:
        """Return the episodes of a portion with an added entry ``adaptation``, the number of each episode's adaptation.

        Episodes that only fill up the last portion are left out. The entry ``task``, which is an index in the portion,
        becomes the task's index in the original pool.
        """
        parts = []
        for slot, adaptations in enumerate(self._adaptations):
            own = {key: values[episodes["slot"] == slot] for key, values in episodes.items()}
            number = portion * self._sizes[slot] + own["task"]
            own |= {"adaptation": number, "task": adaptations[number % len(adaptations)]}
            parts.append({key: values[number < len(adaptations)] for key, values in own.items()})
        return joined_episodes(parts)

    def _set(self, worlds: Sequence[PooledWorld], pools: Sequence[Sequence[np.ndarray]]) -> Iterator[int]:
        for portion in range(self.count):
            chosen = []
            for adaptations, size in zip(self._adaptations, self._sizes, strict=True):
                chosen.append(adaptations[np.arange(portion * size, (portion + 1) * size) % len(adaptations)])
            for world, own in zip(worlds, pools, strict=True):
                named = zip(world.task_names, own, chosen, strict=True)
                world.set_tasks({name: tasks[numbers] for name, tasks, numbers in named})
            yield portion


def _divided_up(number: int, by: int) -> int:
    """Return the quotient, rounded up."""
    return -(-number // by)

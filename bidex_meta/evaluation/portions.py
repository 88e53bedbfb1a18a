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
    """Return each environment's task, numbered over all slots, int64 ``(num_envs,)``."""
    before = torch.tensor([0, *world.num_slot_tasks[:-1]], device=world.task_id.device).cumsum(0)
    return world.task_index + before[world.task_id]


class Portions:
    """Groups of adaptations that are played together.

    Each of the first ``tasks`` of each pool (None: all) has one adaptation in each trial. ``rollouts`` is the number of
    episodes of each task in a shot; None stands for one episode in each environment of the task, with all tasks played
    at once. All numbers are at least 1. The world is not changed.
    """

    def __init__(self, world: TaskWorld, rollouts: int | None, tasks: int | None, trials: int) -> None:
        self._pool_sizes = list(world.num_slot_tasks)
        # This is the task of each adaptation, for each slot.
        self._adaptations = [np.tile(np.arange(min(tasks or size, size)), trials) for size in self._pool_sizes]
        rows = [part.stop - part.start for part in world.slot_env_ids]
        fit = [max(1, number // (rollouts or 1)) for number in rows]
        totals = [len(adaptations) for adaptations in self._adaptations]
        self.count = max(-(-total // at_once) for total, at_once in zip(totals, fit, strict=True))
        self._sizes = [-(-total // self.count) for total in totals]
        self.rollouts = rollouts or min(number // size for number, size in zip(rows, self._sizes, strict=True))

    @contextmanager
    def applied_to(self, worlds: Sequence[TaskWorld]) -> Iterator[Iterator[int]]:
        """Yield an iterator over the portions' numbers; each of its steps sets a portion's tasks in all worlds.

        Afterwards all worlds have their own pools again. Raises BidexError for a world whose tasks cannot be set, or
        whose pools have other lengths.
        """
        for world in worlds:
            if list(world.num_slot_tasks) != self._pool_sizes:
                raise BidexError(
                    f"Expected adapt_world with {self._pool_sizes} tasks in its pools, as world has, got "
                    f"{list(world.num_slot_tasks)}. Give it as many by set_tasks."
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
        """Return a portion's episodes without repetitions, with the number of each one's ``adaptation``.

        ``task`` becomes the index of the task in the pool.
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

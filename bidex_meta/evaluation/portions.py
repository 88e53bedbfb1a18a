"""The tasks of a world in portions that fit its environments, for the meta-test.

Each adaptation (a trial of a task) takes as many environments as it has rollouts. Where the pools hold more than fit,
they are cut into portions of equal size. The last portion is filled up with the first adaptations, which are played
once more and not counted, so that every portion groups the environments alike.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor

from bidex_meta.errors import BidexError
from bidex_meta.utils.validation import whole_number
from bidex_meta.world.contract import PooledWorld, TaskWorld


def task_of_row(world: TaskWorld) -> Tensor:
    """Numbers of the tasks of all slots, int64 ``(num_envs,)``: environments with the same number share a task."""
    before = torch.tensor([0, *world.num_slot_tasks[:-1]], device=world.task_id.device).cumsum(0)
    return world.task_index + before[world.task_id]


def _with_pools(world: TaskWorld) -> PooledWorld:
    if isinstance(world, PooledWorld):
        return world
    raise BidexError(
        f"Expected num_envs of tasks times rollouts from a {type(world).__name__}, whose tasks cannot be set; it has "
        f"{world.num_envs}. Raise num_envs, or leave out tasks, trials and rollouts."
    )


class Portions:
    """Which adaptations are played together.

    Attributes:
        rollouts: Episodes of each task in a shot.
        count: Number of portions.
    """

    def __init__(self, world: TaskWorld, rollouts: int | None, tasks: int | None, trials: int) -> None:
        """Plans; the world is not touched.

        Args:
            world: The world, with its pools of tasks.
            rollouts: Episodes of each task in a shot; None: one in each of its environments, with all tasks at once.
            tasks: Only the first so many of each pool; None: all.
            trials: Adaptations of each task.

        Raises:
            BidexError: A number below 1.
        """
        for name, number in (("rollouts", rollouts), ("tasks", tasks), ("trials", trials)):
            if number is not None:
                whole_number(name, number, 1)
        self._pool_sizes = list(world.num_slot_tasks)
        chosen = [min(tasks or size, size) for size in self._pool_sizes]
        # The task of each adaptation, for each slot.
        self._adaptations = [np.tile(np.arange(number), trials) for number in chosen]
        rows = [part.stop - part.start for part in world.slot_rows]
        fit = [max(1, number // (rollouts or 1)) for number in rows]
        totals = [len(adaptations) for adaptations in self._adaptations]
        self.count = max(-(-total // at_once) for total, at_once in zip(totals, fit, strict=True))
        self._sizes = [-(-total // self.count) for total in totals]
        self.rollouts = rollouts or min(number // size for number, size in zip(rows, self._sizes, strict=True))

    @contextmanager
    def applied_to(self, worlds: Sequence[TaskWorld]) -> Iterator[Iterator[int]]:
        """The portions' numbers; as each is taken, its tasks are put into all worlds. At the end their pools come back.

        Raises:
            BidexError: A world whose tasks cannot be set, or with pools of other lengths.
        """
        for world in worlds:
            if list(world.num_slot_tasks) != self._pool_sizes:
                raise BidexError(
                    f"Expected adapt_world with {self._pool_sizes} tasks in its pools, as world has, got "
                    f"{list(world.num_slot_tasks)}. Give it as many by set_tasks."
                )
        if self._whole():
            yield iter(range(1))
            return
        pooled = [_with_pools(world) for world in worlds]
        pools = [world.pools for world in pooled]
        try:
            yield self._put(pooled, pools)
        finally:
            for world, own in zip(pooled, pools, strict=True):
                world.set_tasks(dict(zip(world.task_names, own, strict=True)))

    def labelled(self, episodes: dict[str, np.ndarray], portion: int) -> dict[str, np.ndarray]:
        """Episodes of one portion that count, as ``play_tasks`` gives them, and the ``adaptation`` of each.

        ``task`` becomes the place in the world's own pools.
        """
        parts = []
        for slot, adaptations in enumerate(self._adaptations):
            own = {key: values[episodes["slot"] == slot] for key, values in episodes.items()}
            number = portion * self._sizes[slot] + own["task"]
            own |= {"adaptation": number, "task": adaptations[number % len(adaptations)]}
            parts.append({key: values[number < len(adaptations)] for key, values in own.items()})
        return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}

    def _whole(self) -> bool:
        """Whether the world's own pools are the only portion."""
        return self.count == 1 and [len(adaptations) for adaptations in self._adaptations] == self._pool_sizes

    def _put(self, worlds: Sequence[PooledWorld], pools: Sequence[Sequence[np.ndarray]]) -> Iterator[int]:
        for portion in range(self.count):
            chosen = [
                adaptations[np.arange(portion * size, (portion + 1) * size) % len(adaptations)]
                for adaptations, size in zip(self._adaptations, self._sizes, strict=True)
            ]
            for world, own in zip(worlds, pools, strict=True):
                named = zip(world.task_names, own, chosen, strict=True)
                world.set_tasks({name: tasks[places] for name, tasks, places in named})
            yield portion

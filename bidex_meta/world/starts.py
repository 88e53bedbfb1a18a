"""Starts of episodes, drawn ahead for many environments at once.

A start depends only on the environment's key and the number of its episode. A vectorised draw for a thousand
environments takes hardly longer than a draw for ten. If starts were drawn one by one as episodes end, they would take a
tenth of a step's time.
"""

from functools import partial
from itertools import chain

import torch
from torch import Tensor

from bidex_meta.world.graphs import Stepper, Together
from bidex_meta.world.part import Part
from bidex_meta.world.random import uniform

# The world makes these draws of an episode: the task, and the elapsed time of a training world's first episode.
_TASK_DRAW = 0
_ELAPSED_DRAW = 1
_OWN_DRAWS = 2
_AHEAD = 8
"""Number of episodes drawn ahead per environment. Some classes fail within ten steps: with one episode drawn ahead, new
draws would be needed at almost every step."""


class Starts:
    """Draws the next episodes of every environment ahead of time, and stores them.

    An episode consists of its task, its start position, and the share of the time limit that counts as elapsed.
    """

    def __init__(
        self,
        parts: list[Part],
        keys: Tensor,
        start_draws: int,
        pool_size: Tensor | None,
        together: Together,
        task_keys: Tensor | None = None,
        episodes_per_task: int = 1,
    ) -> None:
        """Allocate memory for the draws.

        Args:
            parts: The world's groups of environments (``Part``), one per engine.
            keys: Random keys of the environments, (n, 2).
            start_draws: Maximum number of draws that the start of an episode takes in any class.
            pool_size: Number of tasks in the pool of each environment's slot, (n,), if episodes draw tasks; None if
                environments keep their tasks.
            together: Function that runs one job per part.
            task_keys: Random keys of new tasks, (n, 2), if episodes draw new tasks; None: tasks come from the pools.
            episodes_per_task: Number of consecutive episodes that play one drawn task.
        """
        self._together = together
        self._parts = parts
        self._keys = keys
        self._pool_size = pool_size
        self._episodes_per_task = episodes_per_task
        self._draws = _OWN_DRAWS + start_draws
        num = len(keys)
        device = keys.device
        # The bank holds the episodes first ... first + _AHEAD - 1 of each environment.
        self._first = torch.full((num,), -_AHEAD, device=device)
        self._task_index = torch.zeros(num, _AHEAD, dtype=torch.int64, device=device)
        self._elapsed_share = torch.zeros(num, _AHEAD, dtype=torch.float64, device=device)
        shapes = [(part.group.engine.num, _AHEAD, part.start_size) for part in parts]
        self._qpos = [torch.zeros(shape, dtype=torch.float64, device=device) for shape in shapes]
        self._task_keys = task_keys
        pools = chain.from_iterable(part.tasks for part in parts)
        self._task_size = max(tasks.shape[1] for tasks in pools)
        self._avoids_syncs = parts[0].group.engine.avoids_syncs
        self._takes = 0

    def prepare(self, stepper: Stepper, mask: Tensor, number: Tensor, task_index: Tensor) -> None:
        """Draw episodes ahead of time if the next call of ``take`` needs new episodes.

        That call must get the same mask, number and task_index.
        """
        if self._avoids_syncs:
            # An environment begins at most one episode per take, so counting takes replaces reading any number from the
            # device.
            if self._takes % _AHEAD == 0:
                stepper.run(self._draw_all, number, task_index)
            self._takes += 1
            return
        used = number - self._first
        if ((used >= _AHEAD) & mask).any():
            self._draw((used >= _AHEAD // 2).nonzero().squeeze(1), number, task_index)

    def take(self, mask: Tensor, number: Tensor, task_index: Tensor) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Return tasks, elapsed shares and start positions of the next episodes in ``mask``, bool (n,).

        Call ``prepare`` first. If episodes draw new tasks, this method writes them into the pools. ``number`` (n,):
        number of the episode that begins, or would begin next, in each environment. ``task_index`` (n,): task that an
        environment keeps if none is drawn.

        Returns:
            Task of every environment, (n,); share of the time limit that counts as elapsed, in [0, 1), (n,); and for
            each part the start positions (k, start_size) of its k environments in the mask. A part whose engine avoids
            syncs has start positions for all its environments. Values outside the mask are not valid.
        """
        place = (number - self._first).clamp(max=_AHEAD - 1)[:, None]
        shares = self._new_tasks(slice(None), number)
        starts = []
        for part, qpos in zip(self._parts, self._qpos, strict=True):
            at = part.group.take(place)
            rows = part.rows_in(mask)
            if rows is None:
                starts.append(qpos.gather(1, at[:, :, None].expand(-1, 1, qpos.shape[2]))[:, 0])
            else:
                starts.append(qpos[rows, at[rows, 0]])
            if shares is not None:
                part.renew(part.group.take(mask), part.group.take(shares))
        return self._task_index.gather(1, place)[:, 0], self._elapsed_share.gather(1, place)[:, 0], starts

    def _draw(self, env_ids: Tensor, number: Tensor, task_index: Tensor) -> None:
        """Draw the next episodes of some environments, from the given episode numbers on, and store them."""
        self._first[env_ids] = number[env_ids]
        many, ahead = _repeated(env_ids)
        signed, tasks, share = self._numbers(many, number[many] + ahead, task_index)
        shares = self._new_tasks(many, number[many] + ahead)
        self._task_index[env_ids] = tasks.view(-1, _AHEAD)
        self._elapsed_share[env_ids] = share.view(-1, _AHEAD)
        for part, qpos in zip(self._parts, self._qpos, strict=True):
            engine_row = part.engine_rows[many]
            own = engine_row >= 0
            if own.any():
                own_shares = None if shares is None else shares[own]
                start = part.starts(engine_row[own], signed[own], tasks[own], own_shares)
                qpos[engine_row[own], ahead[own]] = start.to(qpos.dtype)

    def _draw_all(self, number: Tensor, task_index: Tensor) -> None:
        """Draw the next episodes of all environments and store them in place.

        The shapes of tensors do not depend on values, so that a CUDA graph can record this method.
        """
        self._first.copy_(number)
        many, ahead = _repeated(torch.arange(len(number), device=number.device))
        signed, tasks, share = self._numbers(many, number[many] + ahead, task_index)
        shares = self._new_tasks(many, number[many] + ahead)
        self._task_index.copy_(tasks.view(-1, _AHEAD))
        self._elapsed_share.copy_(share.view(-1, _AHEAD))

        def place(part: Part, qpos: Tensor) -> None:
            def own(values: Tensor) -> Tensor:
                return part.group.take(values.unflatten(0, (-1, _AHEAD))).flatten(0, 1)

            own_shares = None if shares is None else own(shares)
            qpos.copy_(part.starts(None, own(signed), own(tasks), own_shares).view(qpos.shape))

        self._together([partial(place, part, qpos) for part, qpos in zip(self._parts, self._qpos, strict=True)])

    def _numbers(self, env_ids: Tensor, episode: Tensor, task_index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the random numbers of episodes (k,): draws for the start, task, and elapsed share.

        The draws (k, start_draws) are in [-1, 1]. The task (k,) is an index into the slot's pool. The share (k,) in
        [0, 1) is the part of the time limit that counts as elapsed.
        """
        draws = uniform(self._keys[env_ids], episode, self._draws)
        tasks = task_index[env_ids]
        if self._pool_size is not None:
            of_task = draws
            if self._episodes_per_task > 1:
                of_task = uniform(self._keys[env_ids], episode // self._episodes_per_task, _TASK_DRAW + 1)
            tasks = (of_task[:, _TASK_DRAW] * self._pool_size[env_ids]).long()
        return 2.0 * draws[:, _OWN_DRAWS:] - 1.0, tasks, draws[:, _ELAPSED_DRAW]

    def _new_tasks(self, env_ids: Tensor | slice, episode: Tensor) -> Tensor | None:
        """Return the new tasks of episodes (k,), or None if episodes draw no new tasks.

        A task is a row of shares in [0, 1), (k, size): each number is a position within a range of the variation space.
        """
        if self._task_keys is None:
            return None
        return uniform(self._task_keys[env_ids], episode // self._episodes_per_task, self._task_size)


def _repeated(env_ids: Tensor) -> tuple[Tensor, Tensor]:
    """Return each environment ``_AHEAD`` times in a row, and the number of each copy, from 0 to ``_AHEAD`` - 1.

    For k environments both results have k ``_AHEAD`` entries.
    """
    # Without output_size repeat_interleave would ask the device for the length.
    many = env_ids.repeat_interleave(_AHEAD, output_size=_AHEAD * len(env_ids))
    return many, torch.arange(_AHEAD, device=env_ids.device).repeat(len(env_ids))

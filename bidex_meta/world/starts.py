"""Where episodes start, computed ahead for many rows at once.

A start depends on the row's key and the number of its episode alone, so it need not wait for the episode before to end.
A vectorised draw for a thousand rows takes hardly longer than one for ten; drawn row by row as episodes end, starts
would be a tenth of a step's time.
"""

import torch
from torch import Tensor

from bidex_meta.world.part import Part
from bidex_meta.world.random import uniform

# Draws of an episode that are the world's own: the task, and the elapsed time of a training world's first episode.
_TASK_DRAW, _ELAPSED_DRAW, _OWN_DRAWS = 0, 1, 2


_AHEAD = 8
"""Episodes drawn ahead for a row: some classes fail within ten steps, so one would run out at almost every step."""


class Starts:
    """The coming episodes of every row: their tasks, elapsed shares and positions."""

    def __init__(self, parts: list[Part], keys: Tensor, start_draws: int, pool_size: Tensor | None) -> None:
        """Nothing is drawn yet.

        Args:
            parts: The world's parts.
            keys: Random keys of the world's rows, shape (n, 2).
            start_draws: The largest number of draws of any class.
            pool_size: Tasks of each row's slot, shape (n,), where episodes draw them; None where rows keep theirs.
        """
        self._parts, self._keys, self._pool_size = parts, keys, pool_size
        self._draws = _OWN_DRAWS + start_draws
        num = len(keys)
        # The bank holds the episodes first ... first + _AHEAD - 1 of each row.
        self._first = torch.full((num,), -_AHEAD)
        self._task_index = torch.zeros(num, _AHEAD, dtype=torch.int64)
        self._elapsed_share = torch.zeros(num, _AHEAD, dtype=torch.float64)
        self._qpos = [torch.zeros(p.group.engine.num, _AHEAD, p.start_size).double() for p in parts]

    def take(self, mask: Tensor, number: Tensor, task_index: Tensor) -> tuple[Tensor, Tensor, list[Tensor]]:
        """The starts of the mask's rows.

        Args:
            mask: Rows whose episodes begin, shape (n,), bool.
            number: Number of the episode that begins, or would begin next, of every row, shape (n,).
            task_index: Task that every row keeps where none is drawn, shape (n,).

        Returns:
            Task of every row (n,), elapsed share in [0, 1) of every row (n,), and for each part the starts
            (k, start_size) of its k rows in the mask; the former two are valid where the mask is true.
        """
        place = number - self._first
        if ((place >= _AHEAD) & mask).any():
            half_used = place >= _AHEAD // 2
            self._draw(half_used.nonzero().squeeze(1), number, task_index)
            place = number - self._first
        place = place.clamp(max=_AHEAD - 1)[:, None]
        chosen = [part.group.take(mask).nonzero().squeeze(1) for part in self._parts]
        places = [part.group.take(place)[:, 0] for part in self._parts]
        return (
            self._task_index.gather(1, place)[:, 0],
            self._elapsed_share.gather(1, place)[:, 0],
            [qpos[rows, at[rows]] for qpos, rows, at in zip(self._qpos, chosen, places, strict=True)],
        )

    def _draw(self, rows: Tensor, number: Tensor, task_index: Tensor) -> None:
        """Fills the bank of some of the world's rows, from the given episode numbers on."""
        self._first[rows] = number[rows]
        many = rows.repeat_interleave(_AHEAD)
        ahead = torch.arange(_AHEAD).repeat(len(rows))
        draws = uniform(self._keys[many], number[many] + ahead, self._draws)
        tasks = task_index[many]
        if self._pool_size is not None:
            tasks = (draws[:, _TASK_DRAW] * self._pool_size[many]).long()
        self._task_index[rows] = tasks.view(-1, _AHEAD)
        self._elapsed_share[rows] = draws[:, _ELAPSED_DRAW].view(-1, _AHEAD)
        signed = 2.0 * draws[:, _OWN_DRAWS:] - 1.0
        for part, qpos in zip(self._parts, self._qpos, strict=True):
            engine_row = part.engine_rows[many]
            mine = engine_row >= 0
            if mine.any():
                start = part.starts(engine_row[mine], signed[mine], tasks[mine])
                qpos[engine_row[mine], ahead[mine]] = start.to(qpos.dtype)

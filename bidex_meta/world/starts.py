"""Where episodes start, computed ahead for many rows at once.

A start depends on the row's key and the number of its episode alone. A vectorised draw for a thousand rows takes hardly
longer than one for ten; drawn row by row as episodes end, starts would be a tenth of a step's time.
"""

from functools import partial

import torch
from torch import Tensor

from bidex_meta.world.graphs import Together
from bidex_meta.world.part import Part
from bidex_meta.world.random import uniform

# Draws of an episode that are the world's own: the task, and the elapsed time of a training world's first episode.
_TASK_DRAW, _ELAPSED_DRAW, _OWN_DRAWS = 0, 1, 2
_AHEAD = 8
"""Episodes drawn ahead for a row: some classes fail within ten steps, so one would run out at almost every step."""


class Starts:
    """The coming episodes of every row: their tasks, elapsed shares and positions."""

    def __init__(
        self, parts: list[Part], keys: Tensor, start_draws: int, pool_size: Tensor | None, together: Together
    ) -> None:
        """``keys``: random keys of the world's rows, (n, 2); ``start_draws``: the most draws of any class.

        ``pool_size``: tasks of each row's slot, (n,), where episodes draw them; None where rows keep theirs.
        ``together`` does a job for each part.
        """
        self._together = together
        self._parts, self._keys, self._pool_size = parts, keys, pool_size
        self._draws = _OWN_DRAWS + start_draws
        num, device = len(keys), keys.device
        # The bank holds the episodes first ... first + _AHEAD - 1 of each row.
        self._first = torch.full((num,), -_AHEAD, device=device)
        self._task_index = torch.zeros(num, _AHEAD, dtype=torch.int64, device=device)
        self._elapsed_share = torch.zeros(num, _AHEAD, dtype=torch.float64, device=device)
        shapes = [(part.group.engine.num, _AHEAD, part.start_size) for part in parts]
        self._qpos = [torch.zeros(shape, dtype=torch.float64, device=device) for shape in shapes]
        self._masked = parts[0].group.engine.masked
        self._takes = 0

    def take(self, mask: Tensor, number: Tensor, task_index: Tensor) -> tuple[Tensor, Tensor, list[Tensor]]:
        """The starts of the rows in ``mask``, bool (n,).

        ``number``: of the episode that begins, or would begin next, of every row, (n,); ``task_index``: task that a row
        keeps where none is drawn. Returns task and elapsed share in [0, 1) of every row, (n,), and for each part the
        starts (k, start_size) of its k rows in the mask, or of all where the engine is masked; all valid where the mask
        is true.
        """
        if self._masked:
            return self._take_masked(number, task_index)
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

    def count_take(self) -> bool:
        """Comes before each ``take`` of a masked engine; whether ``draw_all`` must come between.

        A row begins at most one episode a ``take``, so counting them does instead of a look at any number.
        """
        self._takes += 1
        return self._takes % _AHEAD == 1

    def _take_masked(self, number: Tensor, task_index: Tensor) -> tuple[Tensor, Tensor, list[Tensor]]:
        """The same for all rows, without a look at any number."""
        place = (number - self._first)[:, None]
        starts = []
        for part, qpos in zip(self._parts, self._qpos, strict=True):
            at = part.group.take(place)[:, :, None].expand(-1, 1, qpos.shape[2])
            starts.append(qpos.gather(1, at)[:, 0])
        return self._task_index.gather(1, place)[:, 0], self._elapsed_share.gather(1, place)[:, 0], starts

    def _draw(self, rows: Tensor, number: Tensor, task_index: Tensor) -> None:
        """Fills the bank of some of the world's rows, from the given episode numbers on."""
        self._first[rows] = number[rows]
        many = rows.repeat_interleave(_AHEAD)
        ahead = torch.arange(_AHEAD).repeat(len(rows))
        signed, tasks, share = self._numbers(many, number[many] + ahead, task_index)
        self._task_index[rows], self._elapsed_share[rows] = tasks.view(-1, _AHEAD), share.view(-1, _AHEAD)
        for part, qpos in zip(self._parts, self._qpos, strict=True):
            engine_row = part.engine_rows[many]
            mine = engine_row >= 0
            if mine.any():
                start = part.starts(engine_row[mine], signed[mine], tasks[mine])
                qpos[engine_row[mine], ahead[mine]] = start.to(qpos.dtype)

    def draw_all(self, number: Tensor, task_index: Tensor) -> None:
        """Fills the bank of every row; ``number`` and ``task_index`` as in the next ``take``."""
        self._first.copy_(number)
        rows = torch.arange(len(number), device=number.device)
        # A fixed length keeps repeat_interleave from asking the device for it.
        many = rows.repeat_interleave(_AHEAD, output_size=_AHEAD * len(rows))
        ahead = torch.arange(_AHEAD, device=number.device).repeat(len(rows))
        signed, tasks, share = self._numbers(many, number[many] + ahead, task_index)
        self._task_index.copy_(tasks.view(-1, _AHEAD))
        self._elapsed_share.copy_(share.view(-1, _AHEAD))

        def place(part: Part, qpos: Tensor) -> None:
            own, tasks_of = (part.group.take(x.unflatten(0, (-1, _AHEAD))).flatten(0, 1) for x in (signed, tasks))
            qpos.copy_(part.starts(None, own, tasks_of).view(qpos.shape))

        self._together([partial(place, part, qpos) for part, qpos in zip(self._parts, self._qpos, strict=True)])

    def _numbers(self, rows: Tensor, episode: Tensor, task_index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Draws in [-1, 1] (k, start_draws), task (k,) and elapsed share in [0, 1) (k,) of episodes of world rows."""
        draws = uniform(self._keys[rows], episode, self._draws)
        tasks = task_index[rows]
        if self._pool_size is not None:
            tasks = (draws[:, _TASK_DRAW] * self._pool_size[rows]).long()
        return 2.0 * draws[:, _OWN_DRAWS:] - 1.0, tasks, draws[:, _ELAPSED_DRAW]

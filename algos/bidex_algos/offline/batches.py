"""Stored transitions as batches: drawn task by task, with what all of them say of observations and returns."""

import torch
from torch import Tensor

from bidex_algos.replay import Transitions
from bidex_meta.data.joined import Joined

_CHUNK = 65_536


class Batches:
    """Transitions on a device, in batches of ``per_task`` of each of ``num_tasks`` tasks."""

    def __init__(self, data: Joined, num_tasks: int, per_task: int, device: torch.device):
        self._per_task, self._device = per_task, device
        self._observations, self._at, self._actions, self._rewards, self._terminated = (
            each.to(device) for each in (data.observations, data.at, data.actions, data.rewards, data.terminated)
        )
        self._of_task = torch.argsort(data.task, stable=True).to(device)
        self._count = torch.bincount(data.task, minlength=num_tasks).to(device)
        self._first = self._count.cumsum(0) - self._count
        self.fingerprint = data.fingerprint()

    def draw(self, batches: int, generator: torch.Generator) -> Tensor:
        """Places of transitions, uniform within each task: int64 (batches, num_tasks * per_task), task after task."""
        shape = (batches, len(self._count), self._per_task)
        # The remainder of a number this large favours no transition by more than 1 in 2^40 / transitions.
        drawn = torch.randint(2**40, shape, generator=generator, device=self._device) % self._count[:, None]
        return self._of_task[self._first[:, None] + drawn].flatten(1)

    def take(self, places: Tensor) -> Transitions:
        """The transitions at ``places`` (B,)."""
        at = self._at[places]
        return Transitions(
            obs=self._observations.index_select(0, at),
            actions=self._actions.index_select(0, places),
            rewards=self._rewards[places],
            next_obs=self._observations.index_select(0, at + 1),
            terminated=self._terminated[places],
        )

    def chunks(self) -> tuple[Tensor, ...]:
        """All states, some at a time, (n, d) each."""
        return self._observations.split(_CHUNK)


def return_deviation(data: Joined, num_tasks: int, gamma: Tensor | float) -> Tensor:
    """Standard deviation of each task's discounted returns, from every state to the end of its episode: (num_tasks,).

    It doubles the steps that a sum spans until it spans the longest episode. An episode that was cut by time counts up
    to there. 1 where all returns are equal. ``gamma`` is one for all, or (num_tasks,).
    """
    returns = data.rewards.double()
    factor = torch.as_tensor(gamma, dtype=torch.float64).cpu().expand(num_tasks)[data.task]
    span, longest = 1, int(data.left.max()) + 1
    while span < longest:
        inside = data.left[:-span] >= span
        behind = factor[:-span] ** span * returns[span:]
        # One sum of both, not in place: what stands behind must still be of the shorter span.
        returns = torch.cat([returns[:-span] + torch.where(inside, behind, 0.0), returns[-span:]])
        span *= 2
    count = torch.bincount(data.task, minlength=num_tasks)
    mean = torch.zeros(num_tasks, dtype=torch.float64).index_add_(0, data.task, returns) / count
    square = (returns - mean[data.task]).square()
    deviation = (torch.zeros(num_tasks, dtype=torch.float64).index_add_(0, data.task, square) / count).sqrt()
    return torch.where(deviation > 1e-8, deviation, 1.0).float()

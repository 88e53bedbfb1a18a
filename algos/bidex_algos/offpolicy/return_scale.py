"""How large returns are, task by task, so that no task outweighs another."""

import torch
from torch import Tensor

from bidex_algos.advantages import task_moments
from bidex_algos.nets.normalise import RunningStats
from bidex_meta.train.distributed import all_max
from bidex_meta.train.learner import Parts
from bidex_meta.world.contract import VectorWorld

RECENT = 0.9
"""Weight of a reward in the recent ones' mean over that of the next: about the last ten steps count."""


class ReturnScale:
    """Running statistics of the discounted sum of rewards since an episode began.

    Returns of a task fade after ``horizon`` newer ones; ``gamma`` is a discount for all, or of each environment (N,).
    ``stats``: mean and variance of each task (num_tasks,); ``discounted``: the sum in each environment so far (N,).
    """

    def __init__(self, world: VectorWorld, gamma: float | Tensor, horizon: float):
        self.gamma, self.task_id, self.num_tasks = gamma, world.task_id, world.num_tasks
        self.stats = RunningStats((world.num_tasks,), max_count=horizon).to(world.device)
        self.discounted = torch.zeros(world.num_envs, device=world.device)

    def note(self, reward: Tensor, terminated: Tensor, truncated: Tensor, broken: Tensor) -> None:
        """Takes one step of all environments: rewards (N,) and how it ended, bool (N,); broken ones do not count."""
        self.discounted = self.gamma * self.discounted + reward
        self._take(truncated & ~terminated, ~broken)
        self.discounted = self.discounted.masked_fill(terminated | truncated | broken, 0.0)

    def _take(self, cut: Tensor, valid: Tensor) -> None:
        self.stats.merge(*task_moments(self.discounted[None], self.task_id, self.num_tasks, valid[None]))

    def deviation(self) -> Tensor:
        """The deviation of each task's returns, at least a tenth of their mean (num_tasks,)."""
        # Where all returns are about the same, their deviation alone would blow them up.
        return (self.stats.std().square() + (0.1 * self.stats.mean).square()).sqrt().float()

    def parts(self) -> Parts:
        """What a checkpoint holds, by name."""
        return {"return_stats": self.stats, "discounted": self.discounted}


class ReturnBound(ReturnScale):
    """Beside the statistics the largest return of each task, without its sign: what a fixed range of values must hold.

    The sum is discounted towards the episode's beginning and not, as a return is, towards its end, which is known only
    when the episode is over; both weigh any stretch of rewards alike. At a time limit the episode is taken to go on as
    it went, or as it went most recently if that is more: a critic is taught that, though the episode reached such
    states late. ``mass`` is the sum (N,), had all rewards been 1, ``recent`` both with a discount of at most
    :data:`RECENT` (2, N).
    """

    def __init__(self, world: VectorWorld, gamma: float | Tensor, horizon: float):
        super().__init__(world, gamma, horizon)
        self.bound = torch.zeros(world.num_tasks, device=world.device)
        self.mass = torch.zeros(world.num_envs, device=world.device)
        self.recent = torch.zeros(2, world.num_envs, device=world.device)
        self.short = torch.as_tensor(gamma, device=world.device).clamp_max(RECENT)

    def note(self, reward: Tensor, terminated: Tensor, truncated: Tensor, broken: Tensor) -> None:
        """As in the base."""
        self.mass = self.gamma * self.mass + 1.0
        self.recent = self.short * self.recent + torch.stack([reward, torch.ones_like(reward)])
        super().note(reward, terminated, truncated, broken)
        over = terminated | truncated | broken
        self.mass, self.recent = self.mass.masked_fill(over, 0.0), self.recent.masked_fill(over, 0.0)

    def _take(self, cut: Tensor, valid: Tensor) -> None:
        super()._take(cut, valid)
        size, (rewards, mass), rest = self.discounted.abs(), self.recent, 1.0 - self.gamma
        size = torch.where(cut, torch.maximum(size / (rest * self.mass), rewards.abs() / (rest * mass)), size)
        size = size.masked_fill(~valid, 0.0)
        self.bound = all_max(self.bound.scatter_reduce(0, self.task_id, size, "amax"))

    def parts(self) -> Parts:
        """As in the base."""
        return super().parts() | {"return_bound": self.bound, "discounted_ones": self.mass, "recent": self.recent}

"""Teachers beside reinforcement: what they would do in the states of a rollout, and how much a class needs them."""

import torch
from torch import Tensor

from bidex_algos.rollout import EpisodeStatistics, Rollout
from bidex_meta.train.distributed import all_sum
from bidex_meta.witness.teachers import Teachers


class Lessons:
    """Labels of a rollout from teachers that are asked in each of its steps, and the term that draws a policy there.

    The term is that of Schmitt et al. (2018, arXiv 1803.03835). ``task_id``: of each environment, int64 (N,);
    ``weight``: of a class that never succeeds; ``success``: from which on a class's teacher counts nothing.
    """

    def __init__(self, teachers: Teachers, rollout: Rollout, task_id: Tensor, weight: float, success: float):
        self.teachers, self.weight, self.success = teachers, weight, success
        self._rollout, self._taught = rollout, task_id[teachers.known]
        self._labels, self._asked = torch.zeros_like(rollout.actions), 0

    def label(self, obs: Tensor) -> None:
        """Asks for the next step of the rollout, whose raw observations are (N, d)."""
        step = self._asked % len(self._labels)
        before = self._rollout.ended[step - 1]
        # At the first question no teacher knows what came before: it begins there.
        self.teachers.reset(before if self._asked else torch.ones_like(before))
        self._labels[step] = self.teachers.eval_action(obs)
        self._asked += 1

    def weights(self, episodes: EpisodeStatistics) -> Tensor:
        """Of each class, (num_tasks,): falls in a line with its success in the last episodes, and rises with it."""
        _, _, successes, counts = all_sum(episodes.sums)
        needed = (1.0 - successes / counts.clamp_min(1e-9) / self.success).clamp_min(0.0)
        return self.weight * torch.zeros_like(needed).index_copy(0, self._taught, needed[self._taught])

    def distance(self, means: Tensor, log_std: Tensor, index: Tensor) -> Tensor:
        """Half the squared distance of means (b, a) from the labels of samples ``index`` (b,), in deviations: (b,)."""
        return imitation(self._labels.flatten(0, 1)[index], means, log_std)


def imitation(actions: Tensor, means: Tensor, log_std: Tensor) -> Tensor:
    """Half the squared distance, in standard deviations, of actions (B, a) from means (B, a): (B,).

    Deviations, which rewards alone shall move, get no slope.
    """
    return 0.5 * ((actions - means) / log_std.detach().exp()).square().sum(-1)

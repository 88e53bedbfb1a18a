"""Statistics of observations for each task apart.

An entry may lie within a millimetre in one class and a metre in another. By common statistics the first class's entry
hardly moves, and what it tells is learned late.
"""

from typing import Any

import torch
from torch import Tensor

from bidex_algos.nets.encoders.inputs import Inputs
from bidex_algos.nets.normalise import ObservationNormaliser, RunningStats


def observation_normaliser(config: Any, inputs: Inputs, tasks: int) -> ObservationNormaliser:
    """What a config asks for by ``normalise_observations`` and ``normalise_per_task``.

    Args:
        config: An offline learner's.
        inputs: The groups of the observation.
        tasks: Entries of the one-hot of the tasks, 0 without one.
    """
    if config.normalise_per_task and config.normalise_observations and tasks > 1:
        return TaskNormaliser(inputs, tasks)
    return ObservationNormaliser(inputs, config.normalise_observations)


class TaskNormaliser(ObservationNormaliser):
    """Observations to zero mean and unit variance by statistics of their task, clipped; the task id passes unchanged.

    Args:
        inputs: The groups of the observation; ``task_id`` is the one-hot that chooses.
        tasks: Tasks, T.
        clip: Bound of the normalised values.
    """

    def __init__(self, inputs: Inputs, tasks: int, clip: float = 10.0):
        super().__init__(inputs, True, clip)
        self.tasks, self.one_hot = tasks, inputs.columns("task_id")
        self.stats = RunningStats((tasks, self.measured.size))
        self.shift, self.scale = torch.zeros(tasks, inputs.width), torch.ones(tasks, inputs.width)

    def forward(self, obs: Tensor) -> Tensor:
        """Normalises (..., columns), float32."""
        task = self.one_hot(obs).argmax(-1)
        return ((obs - self.shift[task]) * self.scale[task]).clamp_(-self.clip, self.clip)

    @torch.no_grad()
    def update(self, obs: Tensor) -> None:
        """Takes (..., columns) raw observations, of all processes, into the statistics of their tasks."""
        if self.settled or self.measured.size == 0:
            return
        flat = obs.reshape(-1, obs.shape[-1])
        task = self.one_hot(flat).argmax(-1)
        var, mean = torch.zeros(2, self.tasks, self.measured.size, device=obs.device).unbind()
        for seen in task.unique():
            var[seen], mean[seen] = torch.var_mean(self.measured(flat[task == seen]), dim=0, correction=0)
        count = torch.bincount(task, minlength=self.tasks).double()[:, None]
        self.merge(mean, var, count.expand_as(mean).contiguous())

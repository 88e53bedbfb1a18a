"""Running statistics of observations, and of returns per task."""

import math

import torch
from torch import Tensor, nn

from bidex_algos.nets.inputs import Columns, Inputs
from bidex_meta.training.distributed import pool_moments
from bidex_meta.training.learner import LearnerConfig

_FLOOR = 3e-3  # least standard deviation, so that a column that was constant so far does not amplify noise too much
_CONSTANT = 1e-6  # a column with a smaller standard deviation is constant except for rounding
_FOREVER = 1e18  # a count so large that further observations have no weight


class RunningStats(nn.Module):
    """Running mean and variance of each element of a stream, in float64, merged batch by batch (Chan et al.).

    If the count of samples is bounded by ``max_count``, older batches lose weight as newer ones arrive.
    """

    mean: Tensor
    var: Tensor
    count: Tensor

    def __init__(self, shape: tuple[int, ...], max_count: float = math.inf):
        super().__init__()
        self.max_count = max_count
        for name, value in (("mean", 0.0), ("var", 1.0), ("count", 0.0)):
            self.register_buffer(name, torch.full(shape, value, dtype=torch.float64))

    def merge(self, mean: Tensor, var: Tensor, count: Tensor | float) -> None:
        """Merge a batch's mean, (biased) variance and count; elements whose count is 0 do not change."""
        count = torch.as_tensor(count, dtype=torch.float64, device=self.mean.device).expand_as(self.count)
        total = self.count + count
        share = torch.where(count > 0, count / total.clamp_min(1.0), torch.zeros_like(total))
        delta = mean.double() - self.mean
        self.var.lerp_(var.double(), share).add_(share * (1.0 - share) * delta.square())
        self.mean.add_(share * delta)
        self.count.copy_(total.clamp_max(self.max_count))

    def std(self, floor: float = 1e-4) -> Tensor:
        """Return the standard deviation, at least ``floor``, float64."""
        return (self.var + floor**2).sqrt()

    def normalise(self, x: Tensor, element: Tensor) -> Tensor:
        """Scale ``x`` (..., n) to zero mean and unit variance.

        ``element``, int64 (n,), is the index of the element whose statistics apply to each column of ``x``.
        """
        return (x - self.mean.float()[element]) / self.std().float()[element]

    def restore(self, x: Tensor, element: Tensor) -> Tensor:
        """Invert :meth:`normalise` for ``x`` (..., n); the result is 0 if the element has no statistics yet.

        An untrained critic outputs numbers of about 1, which may be a hundred times a return. If these outputs entered
        the first statistics, a hundred iterations would be needed to forget them.
        """
        return (x * self.std().float()[element] + self.mean.float()[element]) * (self.count > 0)[element]


class ObservationNormaliser(nn.Module):
    """Scales observations to zero mean and unit variance, except columns of ``inputs.unscaled``, and clips all columns.

    The statistics of the scaled columns (``measured``) change only in :meth:`update` and :meth:`merge`, so that the
    sampling policy and the learner's update see the same rollout. While ``settled`` is true, :meth:`update` does
    nothing. If not ``enabled``, the module is the identity.
    """

    def __init__(self, inputs: int | Inputs, enabled: bool = True, clip: float = 10.0):
        super().__init__()
        self.enabled = enabled
        self.settled = False
        self.clip = clip
        inputs = Inputs.of(inputs)
        self.measured = inputs.columns(*(group.name for group in inputs.groups if group.name not in inputs.unscaled))
        self.stats = RunningStats((self.measured.size,))
        # These are float32 copies for forward, refreshed by update.
        self.shift: Tensor
        self.scale: Tensor
        self.register_buffer("shift", torch.zeros(inputs.width))
        self.register_buffer("scale", torch.ones(inputs.width))

    def forward(self, obs: Tensor) -> Tensor:
        """Normalise raw observations (..., d); the result is float32."""
        if not self.enabled:
            return obs
        return ((obs - self.shift) * self.scale).clamp_(-self.clip, self.clip)

    def some(self, obs: Tensor, columns: Columns) -> Tensor:
        """Normalise observations (..., n) that consist of only the given columns."""
        if not self.enabled:
            return obs
        return ((obs - columns(self.shift)) * columns(self.scale)).clamp_(-self.clip, self.clip)

    @torch.no_grad()
    def update(self, obs: Tensor) -> None:
        """Add raw observations (..., columns) of all processes to the statistics."""
        if not self.enabled or self.settled or self.measured.size == 0:
            return
        flat = self.measured(obs.reshape(-1, obs.shape[-1]))
        var, mean = torch.var_mean(flat, dim=0, correction=0)
        self.merge(mean, var, torch.full_like(mean, flat.shape[0], dtype=torch.float64))

    @torch.no_grad()
    def keep(self) -> None:
        """Freeze the statistics of columns that have varied, because the network was trained with these statistics."""
        varied = (self.stats.count > 0) & (self.stats.var > _FLOOR**2)  # variances begin at 1
        self.stats.count[varied] = _FOREVER

    @torch.no_grad()
    def merge(self, mean: Tensor, var: Tensor, count: Tensor) -> None:
        """Add the moments of raw observations of all processes to the statistics.

        Mean, variance and count have the shape of the statistics.
        """
        if not self.enabled:
            return
        self.stats.merge(*pool_moments(mean, var, count))
        self.measured.write(self.shift, self.stats.mean.float())
        # A column that was constant in training, such as padding, is not amplified if it varies in an unseen class.
        scale = torch.where(self.stats.var < _CONSTANT**2, 1.0, self.stats.std(_FLOOR).reciprocal())
        self.measured.write(self.scale, scale.float())


def observation_normaliser(config: LearnerConfig, inputs: Inputs, tasks: int) -> ObservationNormaliser:
    """Make the observation normaliser that a learner's config requires, for ``tasks`` tasks.

    The options are ``normalise_observations`` and ``normalise_per_task``.
    """
    options = vars(config)
    if options.get("normalise_per_task") and options["normalise_observations"] and tasks > 1:
        return TaskNormaliser(inputs, tasks)
    return ObservationNormaliser(inputs, options["normalise_observations"])


class TaskNormaliser(ObservationNormaliser):
    """Normalises each observation by the statistics of its own task.

    Columns that vary little within a task, but much between tasks, would otherwise be compressed. ``tasks`` is the
    number of tasks. If a method gets no ``task``, int64 (...), the observation must have the group ``task_id``,
    which shows the task.
    """

    def __init__(self, inputs: Inputs, tasks: int, clip: float = 10.0):
        super().__init__(inputs, True, clip)
        self.tasks = tasks
        self.one_hot = inputs.columns(*[group.name for group in inputs.groups if group.name == "task_id"])
        self.stats = RunningStats((tasks, self.measured.size))
        self.shift = torch.zeros(tasks, inputs.width)
        self.scale = torch.ones(tasks, inputs.width)

    def forward(self, obs: Tensor, task: Tensor | None = None) -> Tensor:
        """Normalise raw observations (..., d), each by the statistics of its task; the result is float32."""
        if task is None:
            task = self.one_hot(obs).argmax(-1)
        return ((obs - self.shift[task]) * self.scale[task]).clamp_(-self.clip, self.clip)

    @torch.no_grad()
    def update(self, obs: Tensor, task: Tensor | None = None) -> None:
        """Add raw observations (..., columns) of all processes to the statistics of their tasks."""
        if self.settled or self.measured.size == 0:
            return
        flat = obs.reshape(-1, obs.shape[-1])
        if task is None:
            of_row = self.one_hot(flat).argmax(-1)
        else:
            of_row = task.flatten()
        var, mean = torch.zeros(2, self.tasks, self.measured.size, device=obs.device).unbind()
        for seen in of_row.unique():
            var[seen], mean[seen] = torch.var_mean(self.measured(flat[of_row == seen]), dim=0, correction=0)
        count = torch.bincount(of_row, minlength=self.tasks).double()[:, None]
        self.merge(mean, var, count.expand_as(mean).contiguous())

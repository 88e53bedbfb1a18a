"""The speed of adapting all tasks at once against a plain Python loop over them, without the world's own time."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.func import functional_call

from bidex_algos.meta.adaptation import Adapter, Params, TaskBatch, detached
from bidex_algos.meta.config import MetaConfig
from bidex_algos.meta.stage import Stage, TaskRows, task_batch
from bidex_algos.nets.networks import GaussianActor, gaussian_log_prob
from bidex_meta.world.threads import set_up_torch

_SIZES = {"point": (4, 2), "hands": (446, 52)}
"""Observations and actions: of a small problem, and of MT20's widest class."""

_CONFIG = MetaConfig(hidden=(64, 64))


def adapt(
    num_tasks: int = 40,
    rollouts: int = 20,
    steps: int = 100,
    repeats: int = 7,
    threads: int | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """One adaptation of each task, layers 64-64, together and one by one.

    It is what a learner does between two stages, three parts: *acting* (actions sampled from every task's own policy at
    each step of its episodes), *advantages* (the linear baseline fitted to the task, generalised advantages of two
    traces, their statistics) and the *inner step* of ProMP. The loop does the same task after task: a policy by
    ``functional_call``, advantages of the task's own rows, the step by autograd.

    Args:
        num_tasks: Tasks.
        rollouts: Rows of each task.
        steps: Steps of an episode.
        repeats: Interleaved repeats; medians are reported.
        threads: Threads of torch; None leaves them as they are.
        seed: Of weights and data.

    Returns:
        For each problem size the seconds of both, the ``ratio`` (loop over together, more = together is faster) of each
        part and of the whole, and the largest ``difference`` of an adapted parameter.
    """
    before = torch.get_num_threads()
    set_up_torch(threads or before)
    try:
        found = {
            name: _Problem(num_tasks, rollouts, steps, *sizes, seed).measured(repeats) for name, sizes in _SIZES.items()
        }
        return {"num_tasks": num_tasks, "threads": torch.get_num_threads(), **found}
    finally:
        torch.set_num_threads(before)


class _Problem:
    """Tasks of one size, with random data."""

    def __init__(self, num_tasks: int, rollouts: int, steps: int, observations: int, actions: int, seed: int):
        g = torch.Generator().manual_seed(seed)
        self.num_tasks = num_tasks
        self.actor = GaussianActor(observations, _CONFIG.hidden, actions, _CONFIG.init_std, g, _CONFIG.activation)
        self.adapter = Adapter(self.actor, _CONFIG.inner_learning_rate, "ratio", _CONFIG.std_range)
        self.rows = TaskRows(torch.arange(num_tasks).repeat_interleave(rollouts))
        self.own_rows = TaskRows(torch.zeros(rollouts, dtype=torch.int64))
        self.meta = detached(dict(self.actor.named_parameters()))
        self.stage = _random_stage(num_tasks * rollouts, steps, observations, actions, g)
        self.stages = [_rows_of(self.stage, slice(k * rollouts, (k + 1) * rollouts)) for k in range(num_tasks)]
        self.batch, self.batches = self._estimate_together(), self._estimate_in_a_loop()
        self.together, self.apart = self._step_together(), self._step_in_a_loop()

    def measured(self, repeats: int) -> dict[str, Any]:
        kinds: dict[str, tuple[Callable[[], Any], Callable[[], Any]]] = {
            "acting": (self._act_together, self._act_in_a_loop),
            "advantages": (self._estimate_together, self._estimate_in_a_loop),
            "inner step": (self._step_together, self._step_in_a_loop),
        }
        times: dict[str, list[tuple[float, float]]] = {name: [] for name in kinds}
        for _ in range(repeats):
            for name, (together, loop) in kinds.items():
                times[name].append((_seconds(together), _seconds(loop)))
        parts = zip(*times.values(), strict=True)
        times["whole"] = [(sum(part[0] for part in once), sum(part[1] for part in once)) for once in parts]
        found: dict[str, Any] = {
            name: {
                "ratio": round(statistics.median(loop / together for together, loop in pairs), 2),
                "together_s": round(statistics.median(pair[0] for pair in pairs), 4),
                "loop_s": round(statistics.median(pair[1] for pair in pairs), 4),
            }
            for name, pairs in times.items()
        }
        found["difference"] = max(
            float((self.together[name][k] - own[name]).abs().max()) for k, own in enumerate(self.apart) for name in own
        )
        return found

    @torch.no_grad()
    def _act_together(self) -> None:
        for obs in self.stage.obs:
            means, log_std = self.adapter.distribution(self.together, self.rows.by_task(obs))
            mean = self.rows.by_row(means)
            torch.addcmul(mean, log_std[self.rows.task_of_row].exp(), torch.randn(mean.shape))

    @torch.no_grad()
    def _act_in_a_loop(self) -> None:
        for own, stage in zip(self.apart, self.stages, strict=True):
            std = own["log_std"].exp()
            for obs in stage.obs:
                mean = functional_call(self.actor, own, (obs,))
                torch.addcmul(mean, std, torch.randn(mean.shape))

    def _estimate_together(self) -> TaskBatch:
        log_std = self.meta["log_std"].expand(self.num_tasks, -1)
        return task_batch(self.stage, self.rows, log_std, _CONFIG)

    def _estimate_in_a_loop(self) -> list[TaskBatch]:
        return [task_batch(stage, self.own_rows, self.meta["log_std"][None], _CONFIG) for stage in self.stages]

    def _step_together(self) -> Params:
        return detached(self.adapter.adapt(detached(self.adapter.meta(self.num_tasks)), self.batch))

    def _step_in_a_loop(self) -> list[Params]:
        return [self._stepped(TaskBatch(*(x[0] for x in batch.tensors()))) for batch in self.batches]

    def _stepped(self, b: TaskBatch) -> Params:
        own: dict[str, Tensor] = {n: p.detach().requires_grad_() for n, p in self.meta.items()}
        log_prob = gaussian_log_prob(b.actions, functional_call(self.actor, own, (b.obs,)), own["log_std"])
        ratio = torch.exp(log_prob - gaussian_log_prob(b.actions, b.old_means, b.old_log_stds))
        gain = (b.weights * ratio * b.advantages).sum() / b.weights.sum()
        slopes = torch.autograd.grad(gain, list(own.values()))
        rate = _CONFIG.inner_learning_rate
        return {n: (p + rate * slope).detach() for (n, p), slope in zip(own.items(), slopes, strict=True)}


def _random_stage(rows: int, steps: int, observations: int, actions: int, g: torch.Generator) -> Stage:
    """Whole episodes of all rows, whose actions are as likely as those of a policy with mean 0."""
    stage, no = Stage(), torch.zeros(rows, dtype=torch.bool)
    for t in range(steps):
        stage.add(
            obs=torch.randn(rows, observations, generator=g),
            actions=_CONFIG.init_std * torch.randn(rows, actions, generator=g),
            means=torch.zeros(rows, actions),
            rewards=torch.randn(rows, generator=g),
            terminated=no,
            ended=torch.full_like(no, t + 1 == steps),
            valid=~no,
            elapsed=torch.full((rows,), t),
        )
    return stage


def _rows_of(stage: Stage, rows: slice) -> Stage:
    return Stage(**{name: [x[rows].clone() for x in steps] for name, steps in vars(stage).items()})


def _seconds(function: Callable[[], Any]) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start

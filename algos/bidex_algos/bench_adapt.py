"""The speed of adapting all tasks at once against a plain Python loop over them, without the world's own time."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.func import functional_call

from bidex_algos.adaptation import Adapter, Params, TaskBatch, detached
from bidex_algos.networks import GaussianActor, gaussian_log_prob

_SIZES = {"point": (4, 2), "hands": (446, 52)}
"""Observations and actions: of a small problem, and of MT20's widest class."""


def adapt(
    num_tasks: int = 40,
    rollouts: int = 20,
    steps: int = 100,
    repeats: int = 7,
    threads: int | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """Acting by adapted policies and one inner step of each, layers 64-64, together and one by one.

    Acting is a forward pass of every task's own policy at each step of its episodes; the inner step is ProMP's, on all
    transitions of these episodes. The loop does the same by ``functional_call`` and autograd, task after task.

    Args:
        num_tasks: Tasks.
        rollouts: Rows of each task.
        steps: Steps of an episode.
        repeats: Interleaved repeats; medians are reported.
        threads: Threads of torch; None leaves them as they are.
        seed: Of weights and data.

    Returns:
        For each problem size the seconds of both, the ``ratio`` (loop over together, more = together is faster) of
        acting, of the inner step and of the whole, and the largest ``difference`` of an adapted parameter.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(threads or before)
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
        self.steps, self.num_tasks = steps, num_tasks
        self.actor = GaussianActor(observations, (64, 64), actions, 0.8, g, "tanh")
        self.adapter = Adapter(self.actor, 0.1, "ratio", (0.1, 1.5))
        self.obs = torch.randn(num_tasks, rollouts, observations, generator=g)
        samples = num_tasks, rollouts * steps
        self.batch = TaskBatch(
            obs=torch.randn(*samples, observations, generator=g),
            actions=torch.randn(*samples, actions, generator=g),
            old_means=torch.zeros(*samples, actions),
            old_log_stds=torch.zeros(num_tasks, actions),
            advantages=torch.randn(*samples, generator=g),
            weights=torch.ones(samples),
        )
        self.together, self.apart = self._adapt_together(), self._adapt_in_a_loop()

    def measured(self, repeats: int) -> dict[str, Any]:
        kinds: dict[str, tuple[Callable[[], Any], Callable[[], Any]]] = {
            "acting": (self._act_together, self._act_in_a_loop),
            "inner step": (self._adapt_together, self._adapt_in_a_loop),
        }
        times: dict[str, list[tuple[float, float]]] = {name: [] for name in kinds}
        for _ in range(repeats):
            for name, (together, loop) in kinds.items():
                times[name].append((_seconds(together), _seconds(loop)))
        times["whole"] = [(a[0] + b[0], a[1] + b[1]) for a, b in zip(times["acting"], times["inner step"], strict=True)]
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
        for _ in range(self.steps):
            self.adapter.distribution(self.together, self.obs)

    @torch.no_grad()
    def _act_in_a_loop(self) -> None:
        for _ in range(self.steps):
            for own, obs in zip(self.apart, self.obs, strict=True):
                functional_call(self.actor, own, (obs,))

    def _adapt_together(self) -> Params:
        return detached(self.adapter.adapt(detached(self.adapter.meta(self.num_tasks)), self.batch))

    def _adapt_in_a_loop(self) -> list[Params]:
        return [self._adapted(TaskBatch(*task)) for task in zip(*self.batch.tensors(), strict=True)]

    def _adapted(self, b: TaskBatch) -> Params:
        own: dict[str, Tensor] = {n: p.detach().requires_grad_() for n, p in self.actor.named_parameters()}
        log_prob = gaussian_log_prob(b.actions, functional_call(self.actor, own, (b.obs,)), own["log_std"])
        ratio = torch.exp(log_prob - gaussian_log_prob(b.actions, b.old_means, b.old_log_stds))
        gain = (b.weights * ratio * b.advantages).sum() / b.weights.sum()
        slopes = torch.autograd.grad(gain, list(own.values()))
        return {n: (p + 0.1 * slope).detach() for (n, p), slope in zip(own.items(), slopes, strict=True)}


def _seconds(function: Callable[[], Any]) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start

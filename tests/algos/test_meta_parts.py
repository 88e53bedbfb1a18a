"""The pieces of the meta-learners: rows by task, the linear baseline, batches, the inner step."""

from typing import Any

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings
from torch import Tensor
from torch.func import functional_call
from torch.testing import assert_close

from bidex_algos.meta.adaptation import Adapter, TaskBatch
from bidex_algos.meta.config import MetaConfig
from bidex_algos.meta.stage import Stage, TaskRows, features, fitted, task_batch
from bidex_algos.nets.networks import GaussianActor, gaussian_log_prob


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(1, 5), min_size=1, max_size=6), st.integers(0, 2**31))
def test_rows_by_task_and_back(sizes: list[int], seed: int):
    g = torch.Generator().manual_seed(seed)
    task_of_row = torch.arange(len(sizes)).repeat_interleave(torch.tensor(sizes))
    task_of_row = task_of_row[torch.randperm(len(task_of_row), generator=g)]
    rows = TaskRows(task_of_row)
    x = torch.randn(3, len(task_of_row), 2, generator=g)
    assert rows.count == len(sizes) and rows.weight.sum(1).tolist() == sizes
    assert torch.equal(rows.by_row(rows.by_task(x[0])), x[0])
    assert torch.equal(rows.steps_by_row(rows.steps_by_task(x), 3), x)
    assert (rows.by_task(task_of_row) == torch.arange(len(sizes))[:, None]).all()
    # A sum over the rectangle counts each row once.
    assert_close((rows.weight[..., None] * rows.by_task(x[0])).sum((0, 1)), x[0].sum(0))


def test_the_baseline_is_the_ridge_regression_of_each_task():
    g = torch.Generator().manual_seed(0)
    obs, elapsed = torch.randn(2, 30, 3, generator=g), torch.arange(30).expand(2, -1)
    x = features(obs, elapsed)
    returns = torch.randn(2, 30, generator=g)
    weights = (torch.rand(2, 30, generator=g) > 0.3).float()
    found = fitted(obs, elapsed, returns, weights, ridge=0.5)
    for k in range(2):
        kept = weights[k] > 0
        a = x[k][kept].double()
        per_sample = torch.tensor([0.5 * 10 / len(a)] * 6 + [0.0] * 4, dtype=a.dtype) + 1e-5
        damping = torch.diag(per_sample * max(float((a * a).sum(0).mean()), 1.0))
        c = torch.linalg.solve(a.T @ a + damping, a.T @ returns[k][kept].double())
        assert_close(found[k], (x[k].double() @ c).float(), rtol=1e-3, atol=1e-4)


def stage_of(rewards: Tensor, valid: Tensor, ended: Tensor, d: int = 2) -> Stage:
    g, stage = torch.Generator().manual_seed(1), Stage()
    for t in range(len(rewards)):
        n = rewards.shape[1]
        stage.add(
            obs=torch.randn(n, d, generator=g), actions=torch.randn(n, 1, generator=g), means=torch.zeros(n, 1),
            rewards=rewards[t], terminated=torch.zeros(n, dtype=torch.bool), ended=ended[t], valid=valid[t],
            elapsed=torch.full((n,), t),
        )  # fmt: skip
    return stage


def test_advantages_are_normalised_in_each_task_and_frozen_steps_weigh_nothing():
    g = torch.Generator().manual_seed(0)
    valid = torch.ones(12, 6, dtype=torch.bool)
    valid[8:, 3:] = False  # the second task's episodes are shorter
    ended = torch.zeros_like(valid)
    ended[7, 3:] = ended[11] = ended[8:, 3:] = True
    rewards = torch.randn(12, 6, generator=g) * torch.tensor([1.0, 1, 1, 1000, 1000, 1000]) * valid
    rows = TaskRows(torch.tensor([0, 0, 0, 1, 1, 1]))
    batch = task_batch(stage_of(rewards, valid, ended), rows, torch.zeros(2, 1), MetaConfig())
    assert batch.weights.sum(1).tolist() == [36.0, 24.0]
    for k in range(2):
        kept = batch.advantages[k][batch.weights[k] > 0]
        assert_close(kept.mean(), torch.tensor(0.0), rtol=0, atol=1e-4)
        assert_close(kept.std(correction=0), torch.tensor(1.0), rtol=0, atol=1e-3)
    by_variance = task_batch(
        stage_of(rewards, valid, ended), rows, torch.zeros(2, 1), MetaConfig(advantage_scale="variance")
    )
    spread = [float(by_variance.advantages[k][by_variance.weights[k] > 0].std()) for k in range(2)]
    assert spread[0] > 100 * spread[1]


def problem(
    seed: int = 0, tasks: int = 3, samples: int = 20, dtype: torch.dtype = torch.float32
) -> tuple[GaussianActor, list[TaskBatch]]:
    g = torch.Generator().manual_seed(seed)
    actor = GaussianActor(4, (5,), 2, 0.6, g, "tanh").to(dtype)

    def batch() -> TaskBatch:
        return TaskBatch(
            obs=torch.randn(tasks, samples, 4, generator=g).to(dtype),
            actions=torch.randn(tasks, samples, 2, generator=g).to(dtype),
            old_means=0.3 * torch.randn(tasks, samples, 2, generator=g).to(dtype),
            old_log_stds=0.1 * torch.randn(tasks, 2, generator=g).to(dtype),
            advantages=torch.randn(tasks, samples, generator=g).to(dtype),
            weights=(torch.rand(tasks, samples, generator=g) > 0.2).to(dtype),
        )

    return actor, [batch(), batch()]


def one_by_one(actor: GaussianActor, batch: TaskBatch, objective: str, rate: float, params: Any = None) -> list[Any]:
    found = []
    for k in range(len(batch.obs)):
        own = {n: p.clone() for n, p in actor.named_parameters()} if params is None else params[k]
        own = {n: p.detach().requires_grad_() for n, p in own.items()}
        mean = functional_call(actor, own, (batch.obs[k],))
        log_prob = gaussian_log_prob(batch.actions[k], mean, own["log_std"])
        if objective == "ratio":
            old = gaussian_log_prob(batch.actions[k], batch.old_means[k], batch.old_log_stds[k])
            log_prob = (log_prob - old).exp()
        weights = batch.weights[k]
        gain = (weights * log_prob * batch.advantages[k]).sum() / weights.sum()
        slopes = torch.autograd.grad(gain, list(own.values()))
        found.append({n: (p + rate * s).detach() for (n, p), s in zip(own.items(), slopes, strict=True)})
    return found


def test_the_head_alone_moves_as_it_does_with_the_rest_and_the_rest_stays():
    actor, [batch, _] = problem()
    whole, head = (Adapter(actor, 0.1, "ratio", (0.01, 10.0), adapted=adapted) for adapted in ("all", "head"))
    start, all_moved, moved = whole.meta(3), whole.adapt(whole.meta(3), batch), head.adapt(head.meta(3), batch)
    assert list(moved) == list(start)
    for name, p in moved.items():
        is_head = name in ("mean.head.weight", "mean.head.bias")
        assert_close(p, all_moved[name] if is_head else start[name])
        assert (p - start[name]).abs().max() > 1e-4 or not is_head


@pytest.mark.parametrize("objective", ["likelihood", "ratio"])
def test_adaptation_of_all_tasks_equals_a_loop_over_them(objective: Any):
    actor, batches = problem()
    adapter = Adapter(actor, 0.1, objective, (0.01, 10.0))
    params, looped = adapter.meta(3), None
    for batch in batches:
        params = adapter.adapt(params, batch)
        looped = one_by_one(actor, batch, objective, 0.1, looped)
        for k, own in enumerate(looped):
            for name, value in own.items():
                assert_close(params[name][k], value, rtol=1e-5, atol=1e-5)
    assert not torch.equal(params["log_std"][0], params["log_std"][1])

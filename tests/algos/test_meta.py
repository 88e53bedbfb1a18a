"""MAML and ProMP: their gradients, their steps, and what they learn on a family with hidden goals."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.distributions import Independent, Normal, kl_divergence
from torch.func import functional_call
from torch.testing import assert_close

from bidex_algos.meta.adaptation import Adapter, TaskBatch, weighted_mean
from bidex_algos.meta.config import MetaConfig
from bidex_algos.meta.maml import MAML, MAMLConfig
from bidex_algos.meta.promp import ProMP, ProMPConfig
from bidex_algos.meta.stage import Stage, TaskRows, features, fitted, task_batch
from bidex_algos.nets.networks import GaussianActor, gaussian_log_prob
from bidex_algos.trust_region import flatten, write
from bidex_meta.errors import BidexError
from tests.algos.families import EndlessGoals, PointClass, PointGoals, circle, played, shot
from tests.algos.ranks import resumed

SHARED: dict[str, Any] = {
    "hidden": (32, 32), "init_std": 0.5, "gamma": 0.99, "tasks_per_class": 8, "normalise_observations": False
}  # fmt: skip
PROMP, MAML_TRPO = ProMPConfig(**SHARED), MAMLConfig(**SHARED, max_kl=0.05)
both = pytest.mark.parametrize(("kind", "config"), [(ProMP, PROMP), (MAML, MAML_TRPO)], ids=["promp", "maml"])


def tiny(kind: Any, config: Any, tasks: int = 3) -> tuple[Any, Any]:
    learner = kind(PointGoals(rows=tasks, classes=(PointClass(count=tasks),)), replace(config, hidden=(5,)), seed=0)
    actor, batches = problem(tasks=tasks, dtype=torch.float64)
    learner.policy.double().actor.load_state_dict(actor.state_dict())
    learner.rows = type(learner.rows)(torch.arange(tasks))
    return learner, batches


@pytest.mark.parametrize(
    ("inner_steps", "adapted", "sizes"),
    [(1, "all", "fixed"), (2, "all", "fixed"), (2, "head", "fixed"), (2, "all", "layer"), (2, "head", "weight")],
)
@both
def test_second_order_gradients_agree_with_finite_differences(
    kind: Any, config: Any, inner_steps: int, adapted: Any, sizes: Any
):
    config = replace(config, inner_learning_rate=0.3, inner_steps=inner_steps, adapted=adapted, step_sizes=sizes)
    learner, batches = tiny(kind, config)
    batches = [batches[0]] * inner_steps + [batches[1]]
    parameters = list(learner.policy.parameters())
    learned = {"fixed": 0, "layer": 5, "weight": len(flatten(learner.policy.actor.mean.head.parameters()))}[sizes]
    assert sum(p.numel() for p in parameters) == learned + sum(p.numel() for p in learner.policy.actor.parameters())
    gradient = flatten(torch.autograd.grad(learner._objective(batches)[0], parameters))
    start = flatten(parameters).detach().clone()
    step = 1e-6
    for i in range(0, len(start), 3):
        values = []
        for sign in (1.0, -1.0):
            moved = start.clone()
            moved[i] += sign * step
            write(parameters, moved)
            values.append(float(learner._objective(batches)[0].detach()))
        write(parameters, start)
        assert float(gradient[i]) == pytest.approx((values[0] - values[1]) / (2 * step), rel=1e-4, abs=1e-7)


@both
def test_first_order_leaves_the_second_derivatives_out(kind: Any, config: Any):
    gradients = []
    for first_order in (False, True):
        learner, batches = tiny(kind, replace(config, inner_learning_rate=0.3, first_order=first_order))
        parameters = list(learner.policy.actor.parameters())
        gradients.append(flatten(torch.autograd.grad(learner._objective(batches)[0], parameters)))
    assert (gradients[0] - gradients[1]).norm() > 1e-3 * gradients[0].norm()
    # The first-order gradient is the gradient at the adapted parameters, as if these were constants.
    adapter = learner.policy.adapter
    adapted = {n: p.detach().requires_grad_() for n, p in adapter.adapt(adapter.meta(3), batches[0]).items()}
    ratio, _ = adapter.ratio_and_kl(adapted, batches[1])
    if kind is ProMP:
        low, high = 1.0 - config.clip, 1.0 + config.clip
        gain = torch.minimum(ratio * batches[1].advantages, ratio.clamp(low, high) * batches[1].advantages)
    else:
        gain = ratio * batches[1].advantages
    slopes = torch.autograd.grad(weighted_mean(gain, batches[1].weights).mean(), list(adapted.values()))
    assert_close(gradients[1], torch.cat([slope.sum(0).flatten() for slope in slopes]))


@pytest.mark.parametrize("kl_weight", [0.0, 0.3])
def test_a_promp_step_equals_an_independent_computation(kl_weight: float):
    config = replace(PROMP, kl_weight=kl_weight, inner_learning_rate=0.2, outer_epochs=1, max_grad_norm=1e9)
    learner, [before, after] = tiny(ProMP, config)
    actor = learner.policy.actor
    start = [p.detach().clone().requires_grad_() for p in actor.parameters()]
    names = [name for name, _ in actor.named_parameters()]
    assert names == ["log_std", "mean.body.0.weight", "mean.body.0.bias", "mean.head.weight", "mean.head.bias"]

    def log_prob(p: list[Tensor], obs: Tensor, actions: Tensor) -> Tensor:
        mean = torch.tanh(obs @ p[1].T + p[2]) @ p[3].T + p[4]
        return -0.5 * (((actions - mean) / p[0].exp()) ** 2 + 2 * p[0] + np.log(2 * np.pi)).sum(-1)

    def moved(p: list[Tensor], batch: TaskBatch, k: int) -> Tensor:
        old = Independent(Normal(batch.old_means[k], batch.old_log_stds[k].exp()), 1)
        mean = torch.tanh(batch.obs[k] @ p[1].T + p[2]) @ p[3].T + p[4]
        divergence = kl_divergence(old, Independent(Normal(mean, p[0].exp().expand_as(mean)), 1))
        return (batch.weights[k] * divergence).sum() / batch.weights[k].sum()

    total = torch.zeros((), dtype=torch.float64)
    kl = torch.zeros((), dtype=torch.float64)
    for k in range(3):
        old = gaussian_log_prob(before.actions[k], before.old_means[k], before.old_log_stds[k])
        ratio = torch.exp(log_prob(start, before.obs[k], before.actions[k]) - old)
        inner = (before.weights[k] * ratio * before.advantages[k]).sum() / before.weights[k].sum()
        kl = kl + moved(start, before, k) / 3
        slopes = torch.autograd.grad(inner, start, create_graph=True)
        adapted = [p + 0.2 * s for p, s in zip(start, slopes, strict=True)]
        old = gaussian_log_prob(after.actions[k], after.old_means[k], after.old_log_stds[k])
        ratio = torch.exp(log_prob(adapted, after.obs[k], after.actions[k]) - old)
        kept = torch.min(ratio * after.advantages[k], ratio.clamp(0.7, 1.3) * after.advantages[k])
        total = total + (after.weights[k] * kept).sum() / after.weights[k].sum() / 3
    slopes = torch.autograd.grad(kl_weight * kl - total, start)
    expected = [p - 1e-3 * s / (s.abs() + 1e-8) for p, s in zip(start, slopes, strict=True)]

    told = learner._outer([before, after])
    assert_close(told["Loss/surrogate"], -total.detach())
    for parameter, value in zip(actor.parameters(), expected, strict=True):
        assert_close(parameter.detach(), value.detach(), rtol=1e-6, atol=1e-9)


def test_promps_step_size_follows_the_kl_that_is_asked_for():
    def iterated(desired: float | None, rate: float) -> list[dict[str, float]]:
        config = replace(PROMP, desired_kl=desired, outer_learning_rate=rate, outer_epochs=5)
        learner = ProMP(PointGoals(rows=32), config, seed=0)
        return [learner.iterate() for _ in range(8)]

    for rate in (1e-2, 1e-5):  # far too large, far too small
        fixed, adaptive = iterated(None, rate), iterated(0.01, rate)
        assert not 0.003 < fixed[-1]["Policy/outer_kl"] < 0.03
        assert 0.003 < adaptive[-1]["Policy/outer_kl"] < 0.03
        assert fixed[-1]["Policy/outer_learning_rate"] == pytest.approx(rate)
        assert (adaptive[-1]["Policy/outer_learning_rate"] < rate) == (rate == 1e-2)


@pytest.mark.parametrize("max_kl", [0.003, 0.03])
def test_mamls_trust_region_holds_after_adaptation(max_kl: float):
    learner = MAML(PointGoals(rows=32), replace(MAML_TRPO, max_kl=max_kl), seed=0)
    told = [learner.iterate() for _ in range(3)]
    assert all(0.2 * max_kl < t["Policy/outer_kl"] <= max_kl for t in told)
    assert all(t["Loss/surrogate"] < 0 for t in told)


def returns(learner: Any) -> list[float]:
    """Before the adaptation and after it, on goals between those of the training."""
    world = PointGoals(rows=80)
    world.set_tasks({"PointGoals": circle(8, first=np.pi / 8)})
    policy = learner.load_policy(learner.policy_state_dict())
    policy.assign(world.task_index)
    before = played(policy.eval_action, world, seed=9)
    shot(policy, world, seed=100)
    return [before, played(policy.eval_action, world, seed=9)]


@both
def test_one_inner_step_closes_the_gap_to_a_policy_that_sees_the_goal(kind: Any, config: Any):
    learner = kind(PointGoals(rows=80), config, seed=0)
    for _ in range(25 if kind is ProMP else 12):
        learner.iterate()
    before, after = returns(learner)
    seeing = PointGoals(rows=80, goal_visible=True)
    seeing.set_tasks({"PointGoals": circle(8, first=np.pi / 8)})
    best = played(seeing.best, seeing, seed=9)
    assert (after - before) / (best - before) > 0.4


@pytest.mark.parametrize("sizes", ["layer", "weight"])
def test_step_sizes_that_are_far_too_small_are_learned(sizes: Any):
    """Begun with 1 / 50 of the inner step that PointGoals wants, adaptation gains next to nothing unless they grow."""
    gained = []
    for each in ("fixed", sizes):
        chosen = replace(PROMP, inner_learning_rate=0.002, step_sizes=each, step_size_rate=0.5)
        learner = ProMP(PointGoals(rows=80), chosen, seed=0)
        for _ in range(12):
            told = learner.iterate()
        before, after = returns(learner)
        gained.append(after - before)
        assert ("Policy/inner_learning_rate" in told) == (each != "fixed")
    assert told["Policy/inner_learning_rate"] > 0.004 and gained[1] > 10 * gained[0]


@both
def test_a_standard_deviation_beyond_its_bounds_comes_back(kind: Any, config: Any):
    config = replace(config, tasks_per_class=4, std_range=(0.3, 0.6))
    learner = kind(PointGoals(rows=16), config, seed=0)
    with torch.no_grad():
        learner.policy.actor.log_std.fill_(2.0)
    assert learner.iterate()["Policy/std"] <= 0.6 + 1e-6
    moved = learner.policy.actor.log_std - float(np.log(0.6))
    assert 1e-5 < moved.abs().max() < 0.5  # put on the bound, and from there by a gradient that is not 0


def test_a_meta_batch_draws_tasks_without_repetition_and_splits_rows_over_them():
    world = PointGoals(rows=24, classes=(PointClass("A", count=8), PointClass("B", count=3)))
    learner = ProMP(world, replace(PROMP, tasks_per_class=4), seed=0)
    seen = set()
    for _ in range(4):
        learner.iterate()
        assert [len(pool) for pool in world.pools] == [4, 3]
        assert all(len(np.unique(pool, axis=0)) == len(pool) for pool in world.pools)
        assert torch.bincount(learner.rows.task_of_row).tolist() == [3, 3, 3, 3, 4, 4, 4]
        seen |= {tuple(np.round(goal, 6)) for goal in world.pools[0]}
    assert len(seen) > 4
    assert [len(pool) for pool in learner.pools] == [8, 3]


@pytest.mark.parametrize("slice_steps", [None, 2])
def test_each_meta_batch_has_new_tasks_where_they_are_without_number(slice_steps: int | None):
    config = replace(PROMP, tasks_per_class=9, slice_steps=slice_steps, hidden=(8,))
    mode = ProMP.autoreset_mode(config)

    def learner_of(seed: int) -> ProMP:
        world = EndlessGoals(rows=18, classes=(PointClass(steps=6),), autoreset_mode=mode)  # its pool has 8 tasks
        return ProMP(world, config, seed)

    learner = learner_of(0)
    seen = set()
    for _ in range(8):
        learner.iterate()
        (pool,) = learner.world.pools
        assert len(pool) == 9 and torch.bincount(learner.rows.task_of_row).tolist() == [2] * 9
        seen.add(pool.tobytes())
    assert len(seen) == 8 if slice_steps is None else 1 < len(seen) < 8
    resumed(learner_of, iterations=1)


def test_before_any_data_an_adapting_policy_is_the_meta_policy_and_init_goes_back_to_it():
    learner = ProMP(PointGoals(rows=16), PROMP, seed=0)
    learner.iterate()
    policy = learner.load_policy(learner.policy_state_dict())
    obs, _ = learner.world.reset()
    policy.assign(None)  # a task in each row
    policy.adapt()
    assert torch.equal(policy.eval_action(obs), learner.eval_action(obs))
    shot(policy, learner.world)
    moved = policy.eval_action(obs)
    assert not torch.equal(moved, learner.eval_action(obs)) and moved.abs().max() <= 1.0
    policy.init()
    assert torch.equal(policy.eval_action(obs), learner.eval_action(obs))


def test_bad_input_is_one_line():
    with pytest.raises(BidexError, match=r"8 tasks.*num_envs of at least 8"):
        ProMP(PointGoals(rows=4), PROMP, seed=0)
    learner = ProMP(PointGoals(rows=8), PROMP, seed=0)
    with pytest.raises(BidexError, match=r"8 environments.*9"):
        ProMP(PointGoals(rows=9), PROMP, seed=0).load_state_dict(learner.state_dict())


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


def test_advantages_are_normalised_in_each_task_and_frozen_steps_weigh_nothing():
    g = torch.Generator().manual_seed(0)
    valid = torch.ones(12, 6, dtype=torch.bool)
    valid[8:, 3:] = False  # the second task's episodes are shorter
    ended = torch.zeros_like(valid)
    ended[7, 3:] = ended[11] = ended[8:, 3:] = True
    rewards = torch.randn(12, 6, generator=g) * torch.tensor([1.0, 1, 1, 1000, 1000, 1000]) * valid
    rows, stage = TaskRows(torch.tensor([0, 0, 0, 1, 1, 1])), Stage()
    for t in range(12):
        stage.add(
            obs=torch.randn(6, 2, generator=g), actions=torch.randn(6, 1, generator=g), means=torch.zeros(6, 1),
            rewards=rewards[t], terminated=torch.zeros(6, dtype=torch.bool), ended=ended[t], valid=valid[t],
            elapsed=torch.full((6,), t),
        )  # fmt: skip
    batch = task_batch(stage, rows, torch.zeros(2, 1), MetaConfig())
    assert batch.weights.sum(1).tolist() == [36.0, 24.0]
    for k in range(2):
        kept = batch.advantages[k][batch.weights[k] > 0]
        assert_close(kept.mean(), torch.tensor(0.0), rtol=0, atol=1e-4)
        assert_close(kept.std(correction=0), torch.tensor(1.0), rtol=0, atol=1e-3)
    by_variance = task_batch(stage, rows, torch.zeros(2, 1), MetaConfig(advantage_scale="variance"))
    spread = [float(by_variance.advantages[k][by_variance.weights[k] > 0].std()) for k in range(2)]
    assert spread[0] > 100 * spread[1]


def problem(tasks: int = 3, dtype: torch.dtype = torch.float32) -> tuple[GaussianActor, list[TaskBatch]]:
    g = torch.Generator().manual_seed(0)
    actor = GaussianActor(4, (5,), 2, 0.6, g, "tanh").to(dtype)

    def normal(*shape: int, scale: float = 1.0) -> Tensor:
        return scale * torch.randn(tasks, *shape, generator=g).to(dtype)

    def batch() -> TaskBatch:
        return TaskBatch(
            obs=normal(20, 4), actions=normal(20, 2), old_means=normal(20, 2, scale=0.3),
            old_log_stds=normal(2, scale=0.1), advantages=normal(20), weights=(normal(20) > -0.8).to(dtype),
        )  # fmt: skip

    return actor, [batch(), batch()]


@pytest.mark.parametrize("objective", ["likelihood", "ratio"])
@pytest.mark.parametrize("adapted", ["all", "head"])
def test_adaptation_of_all_tasks_equals_a_loop_over_them(objective: Any, adapted: Any):
    actor, batches = problem()
    adapter = Adapter(actor, 0.1, objective, (0.01, 10.0), adapted=adapted)
    params = adapter.meta(3)
    for batch in batches:
        moved = adapter.adapt(params, batch)
        for k in range(3):
            own = {name: p[k].detach().requires_grad_() for name, p in params.items()}
            gain = gaussian_log_prob(batch.actions[k], functional_call(actor, own, (batch.obs[k],)), own["log_std"])
            if objective == "ratio":
                gain = (gain - gaussian_log_prob(batch.actions[k], batch.old_means[k], batch.old_log_stds[k])).exp()
            gain = (batch.weights[k] * gain * batch.advantages[k]).sum() / batch.weights[k].sum()
            for (name, p), slope in zip(own.items(), torch.autograd.grad(gain, list(own.values())), strict=True):
                rate = 0.1 * (adapted == "all" or name.startswith("mean.head."))
                assert_close(moved[name][k], p + rate * slope, rtol=1e-5, atol=1e-5)
        params = moved
    assert not torch.equal(params["mean.head.bias"][0], params["mean.head.bias"][1])


@both
def test_a_second_shot_adapts_what_the_first_has_adapted(kind: Any, config: Any):
    config = replace(config, hidden=(5,), inner_learning_rate=0.3, max_adapt_steps=None)
    world = PointGoals(rows=3, classes=(PointClass(count=3),))
    agent = kind.load_policy(kind(world, config, seed=0).policy_state_dict())
    agent.init()
    found = []
    given = []
    adapt = agent.adapter.adapt

    def recorded(params: Any, batch: TaskBatch) -> Any:
        given.append(({name: value.clone() for name, value in params.items()}, batch.obs.shape[1]))
        found.append(adapt(params, batch))
        return found[-1]

    agent.adapter.adapt = recorded
    for _ in range(2):
        shot(agent, world)
        assert len(agent.stage) == 0
    (_, first), (start, second) = given
    assert first == second, "the second batch holds the second shot alone"
    for name, value in start.items():
        assert_close(value, found[0][name])


def test_an_outer_step_of_maml_by_adam_raises_its_objective():
    config = replace(MAML_TRPO, outer="adam", outer_learning_rate=1e-4, inner_learning_rate=0.3)
    learner, batches = tiny(MAML, config)
    before = float(learner._objective(batches)[0].detach())
    learner._outer(batches)
    assert float(learner._objective(batches)[0].detach()) > before + 1e-7

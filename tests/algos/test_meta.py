"""MAML and ProMP: their gradients, their steps, and what they learn on a family with hidden goals."""

from dataclasses import replace
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from torch import Tensor
from torch.func import functional_call
from torch.testing import assert_close

from bidex_algos.meta.adaptation import Adapter, TaskBatch, weighted_mean
from bidex_algos.meta.base import make_meta_policy
from bidex_algos.meta.config import MetaConfig
from bidex_algos.meta.maml import MAML, MAMLConfig
from bidex_algos.meta.promp import ProMP, ProMPConfig
from bidex_algos.meta.stage import Stage, TaskRows, features, fitted, task_batch
from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import GaussianActor, gaussian_log_prob
from bidex_algos.trust_region import flatten, write
from bidex_meta.agents import Timestep
from bidex_meta.errors import BidexError
from bidex_meta.world.contract import plain_groups
from tests.algos.families import PointClass, PointGoals, circle
from tests.tasks.test_mask import twins

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


def surrogate(learner: Any, batches: Any) -> Tensor:
    return learner._objective(batches)[0]


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
    gradient = flatten(torch.autograd.grad(surrogate(learner, batches), parameters))
    start = flatten(parameters).detach().clone()
    step = 1e-6
    for i in range(0, len(start), 3):
        values = []
        for sign in (1.0, -1.0):
            moved = start.clone()
            moved[i] += sign * step
            write(parameters, moved)
            values.append(float(surrogate(learner, batches).detach()))
        write(parameters, start)
        assert float(gradient[i]) == pytest.approx((values[0] - values[1]) / (2 * step), rel=1e-4, abs=1e-7)


@both
def test_first_order_leaves_the_second_derivatives_out(kind: Any, config: Any):
    gradients = []
    for first_order in (False, True):
        learner, batches = tiny(kind, replace(config, inner_learning_rate=0.3, first_order=first_order))
        parameters = list(learner.policy.actor.parameters())
        gradients.append(flatten(torch.autograd.grad(surrogate(learner, batches), parameters)))
    assert (gradients[0] - gradients[1]).norm() > 1e-3 * gradients[0].norm()
    # The first-order gradient is that at the adapted parameters, as if they were given.
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


def test_a_promp_step_without_kl_equals_an_independent_computation():
    config = replace(PROMP, kl_weight=0.0, inner_learning_rate=0.2, outer_epochs=1, max_grad_norm=1e9)
    learner, [before, after] = tiny(ProMP, config)
    actor = learner.policy.actor
    start = [p.detach().clone().requires_grad_() for p in actor.parameters()]
    names = [name for name, _ in actor.named_parameters()]
    assert names == ["log_std", "mean.body.0.weight", "mean.body.0.bias", "mean.head.weight", "mean.head.bias"]

    def log_prob(p: list[Tensor], obs: Tensor, actions: Tensor) -> Tensor:
        mean = torch.tanh(obs @ p[1].T + p[2]) @ p[3].T + p[4]
        return -0.5 * (((actions - mean) / p[0].exp()) ** 2 + 2 * p[0] + np.log(2 * np.pi)).sum(-1)

    total = torch.zeros((), dtype=torch.float64)
    for k in range(3):
        old = gaussian_log_prob(before.actions[k], before.old_means[k], before.old_log_stds[k])
        ratio = torch.exp(log_prob(start, before.obs[k], before.actions[k]) - old)
        inner = (before.weights[k] * ratio * before.advantages[k]).sum() / before.weights[k].sum()
        slopes = torch.autograd.grad(inner, start, create_graph=True)
        adapted = [p + 0.2 * s for p, s in zip(start, slopes, strict=True)]
        old = gaussian_log_prob(after.actions[k], after.old_means[k], after.old_log_stds[k])
        ratio = torch.exp(log_prob(adapted, after.obs[k], after.actions[k]) - old)
        kept = torch.min(ratio * after.advantages[k], ratio.clamp(0.7, 1.3) * after.advantages[k])
        total = total + (after.weights[k] * kept).sum() / after.weights[k].sum() / 3
    slopes = torch.autograd.grad(-total, start)
    expected = [p - 1e-3 * s / (s.abs() + 1e-8) for p, s in zip(start, slopes, strict=True)]

    told = learner._outer([before, after])
    assert_close(told["Loss/surrogate"], -total.detach())
    for parameter, value in zip(actor.parameters(), expected, strict=True):
        assert_close(parameter.detach(), value.detach(), rtol=1e-6, atol=1e-9)


def test_the_kl_weight_holds_the_policy_before_adaptation_back():
    kls = []
    for weight in (0.0, 10.0):
        learner = ProMP(PointGoals(rows=32), replace(PROMP, kl_weight=weight, outer_epochs=8), seed=0)
        kls.append(learner.iterate()["Policy/inner_kl"])
    assert kls[1] < 0.5 * kls[0]


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


def returns(learner: Any, shots: int = 1) -> list[float]:
    world = PointGoals(rows=80)
    world.set_tasks({"PointGoals": circle(8, first=np.pi / 8)})
    policy = learner.load_policy(learner.policy_state_dict())
    policy.assign(world.task_index)
    found = []
    for shot in range(shots + 1):
        found.append(played(world, policy.eval_action, seed=9))
        obs, _ = world.reset(seed=100 + shot)
        for _ in range(20):
            action, aux = policy.adapt_action(obs)
            following, reward, terminated, truncated, _ = world.step(action)
            policy.step(Timestep(obs, action, reward, terminated, truncated, aux, following))
            obs = following
        policy.adapt()
    return found


def played(world: PointGoals, act: Any, seed: int) -> float:
    obs, _ = world.reset(seed=seed)
    total = torch.zeros(world.num_envs)
    for _ in range(20):
        obs, reward, *_ = world.step(act(obs))
        total += reward
    return float(total.mean())


@pytest.mark.parametrize("seed", [0, 1, 2])
@both
def test_one_inner_step_closes_the_gap_to_a_policy_that_sees_the_goal(kind: Any, config: Any, seed: int):
    learner = kind(PointGoals(rows=80, seed=seed), config, seed=seed)
    for _ in range(25 if kind is ProMP else 12):
        learner.iterate()
    before, after = returns(learner)
    seeing = PointGoals(rows=80, goal_visible=True)
    seeing.set_tasks({"PointGoals": circle(8, first=np.pi / 8)})
    best = played(seeing, seeing.best, seed=9)
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


def test_a_step_size_below_zero_comes_back_to_it():
    learner = ProMP(PointGoals(rows=16), replace(PROMP, step_sizes="weight"), seed=0)
    factors = learner.policy.step_sizes["mean.head.weight"]
    with torch.no_grad():
        factors[0, :2] = torch.tensor([-0.5, 0.5])
    learner.policy.adapter.project()
    assert factors[0, :2].tolist() == [0.0, 0.5] and float(learner.policy.step_sizes.mean()) < 1.0


def test_steps_and_statistics_of_observations_are_those_of_what_rows_played():
    classes = (PointClass("Long", steps=20), PointClass("Short", steps=9))
    world = PointGoals(rows=16, classes=classes, unstable=((2, 5),), end_at_goal=True)
    learner = ProMP(world, replace(PROMP, tasks_per_class=4, normalise_observations=True), seed=0)
    first, _ = world.reset(seed=0)
    played, reset, step = [first.double()], world.reset, world.step
    counted: list[int] = []
    now = first

    def spy_reset(**options: Any) -> Any:
        nonlocal now
        now, info = reset(**options)
        return now, info

    def spy_step(action: Tensor) -> Any:
        nonlocal now
        running, before = ~world.episodes.finished, now
        found = step(action)
        played.append(before[running & ~found[4]["unstable"]].double())
        counted.append(int(running.sum()))
        now = found[0]
        return found

    world.reset, world.step = spy_reset, spy_step  # type: ignore[method-assign]
    learner.iterate()
    assert learner.env_steps == sum(counted) < 2 * 20 * 16
    seen, stats = torch.cat(played), learner.policy.observations.stats
    assert ((seen - seen[:16].mean(0)) / seen[:16].std(0)).nan_to_num().abs().max() > 10  # some were clipped
    assert_close(stats.mean, seen.mean(0), atol=1e-6, rtol=1e-5)
    assert_close(stats.var, seen.var(0, correction=0), atol=1e-6, rtol=1e-5)


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


def test_before_any_data_an_adapting_policy_is_the_meta_policy_and_init_goes_back_to_it():
    learner = ProMP(PointGoals(rows=16), PROMP, seed=0)
    learner.iterate()
    policy = learner.load_policy(learner.policy_state_dict())
    obs, _ = learner.world.reset()
    policy.assign(None)  # a task in each row
    policy.adapt()
    assert torch.equal(policy.eval_action(obs), learner.eval_action(obs))
    action, aux = policy.adapt_action(obs)
    following, reward, terminated, truncated, _ = learner.world.step(action)
    policy.step(Timestep(obs, action, reward, terminated, truncated, aux, following))
    policy.adapt()
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


@pytest.mark.parametrize(("rule", "equal"), [("masked", True), ("plain", False)])
def test_rows_in_one_state_with_other_tasks_look_alike_to_policy_and_baseline(rule: str, equal: bool):
    _, obs, reward = twins("CatchUnderarm", True, rule)
    assert len(reward.unique()) > 1
    inputs = Inputs(plain_groups(obs.shape[1], 0))
    policy = make_meta_policy(PROMP, "ratio", inputs, 52, torch.Generator().manual_seed(0), seed=0)
    _, aux = policy.adapt_action(obs)
    x = features(policy.observations(obs), torch.zeros(len(obs)))
    assert torch.equal(aux["mean"], aux["mean"][:1].expand_as(aux["mean"])) == equal
    assert torch.equal(x, x[:1].expand_as(x)) == equal


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

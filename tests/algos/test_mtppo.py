from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.distributions import Independent, Normal, kl_divergence
from torch.testing import assert_close

from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import GaussianActor, gaussian_kl
from bidex_algos.onpolicy.mtppo import MTPPO, MTPPOConfig
from bidex_algos.onpolicy.mttrpo import MTTRPO, MTTRPOConfig
from bidex_algos.rollout import collect_rollout
from bidex_algos.trust_region import fisher_product, flatten
from bidex_meta.world.contract import plain_groups
from tests.algos.problems import trained
from tests.algos.ranks import same
from tests.algos.toy import ToyWorld, nearness

SMALL = MTPPOConfig(
    hidden=(32, 32), rollout_steps=8, learning_rate_range=(1e-5, 2e-3), std_range=(0.05, 1.0), autocast="off"
)


@pytest.mark.parametrize(("terminal", "value"), [(False, 5.0), (True, 1.0)])
def test_a_time_limit_is_bootstrapped_and_a_true_end_is_not(terminal: bool, value: float):
    # A reward of 1 per step with gamma 0.8 is worth 1 / (1 - 0.8) = 5 if only a time limit ends the episodes of one
    # step.
    world = ToyWorld([lambda action: torch.ones(len(action))], horizon=1, terminal=terminal)
    learner = MTPPO(world, replace(SMALL, gamma=0.8, critic_learning_rate=3e-3), seed=0)
    for _ in range(60):
        learner.iterate()
    obs, _ = world.reset(seed=1)
    assert_close(learner._final_value(obs, world.task_id), torch.full((32,), value), rtol=0.05, atol=0)


def test_the_step_size_follows_the_kl():
    learner = MTPPO(ToyWorld([nearness(0.6)]), SMALL, seed=0)
    rates = []
    for kl in (2.5 * SMALL.desired_kl, SMALL.desired_kl, 0.1 * SMALL.desired_kl):
        learner.adams.follow(torch.tensor(kl))
        rates.append(float(learner.adams.rate))
    assert rates == pytest.approx([2e-4, 2e-4, 3e-4])
    for kl, bound in ((1.0, 1e-5), (0.0, 2e-3)):
        for _ in range(40):
            learner.adams.follow(torch.tensor(kl))
        assert float(learner.adams.rate) == pytest.approx(bound)
    assert learner.adams.actor.param_groups[0]["lr"] is learner.adams.rate


@pytest.mark.parametrize(("kind", "config"), [(MTPPO, SMALL), (MTTRPO, MTTRPOConfig(hidden=(8,)))], ids=["ppo", "trpo"])
def test_the_standard_deviation_keeps_its_bounds(kind: Any, config: Any):
    learner = trained(kind, ToyWorld([nearness(0.6)]), replace(config, std_range=(0.79, 0.81)), 8)
    std = learner.policy.actor.log_std.exp()
    assert std.min() > 0.789 and std.max() < 0.811


TRPO = MTTRPOConfig(hidden=(32, 32), rollout_steps=8, std_range=(0.2, 1.0), fisher_stride=1, max_kl=0.03)


def ready(config: MTTRPOConfig, world: ToyWorld) -> MTTRPO:
    learner = MTTRPO(world, config, seed=0)
    learner.iterate()
    assert learner.obs is not None
    collect_rollout(world, learner.rollout, learner.obs, learner._sample, learner._final_value, learner.episodes)
    return learner


@pytest.mark.parametrize("max_kl", [0.003, 0.03, 0.3])
@pytest.mark.parametrize("policy_heads", [False, True])
def test_the_kl_after_the_step_is_kept_and_nearly_used(max_kl: float, policy_heads: bool):
    learner = ready(replace(TRPO, max_kl=max_kl, policy_heads=policy_heads), ToyWorld([nearness(0.6), nearness(-0.6)]))
    obs = learner.rollout.obs.flatten(0, 1)
    before = [part.clone() for part in learner.policy.distribution(obs)]
    told = learner._update(learner._prepare()[0])["Policy/kl"]
    after = learner.policy.distribution(obs)
    p, q = (Independent(Normal(mean, log_std.exp().expand(mean.shape)), 1) for mean, log_std in (before, after))
    kl = kl_divergence(p, q).mean()
    assert 0.3 * max_kl < kl <= max_kl * (1 + 1e-5)
    assert_close(told.float(), kl, rtol=1e-3, atol=1e-6)


def test_it_learns_with_hidden_layers_in_bfloat16():
    learner = MTTRPO(ToyWorld([nearness(0.6)]), replace(TRPO, autocast="on"), seed=0)
    assert learner.iterate()["Policy/kl"] <= 0.031


def test_a_step_that_the_line_search_refuses_leaves_the_policy_alone():
    learner = ready(replace(TRPO, accept_ratio=1.0, backtracks=1, max_kl=1.0), ToyWorld([nearness(0.6)]))
    before = [p.detach().clone() for p in learner.policy.actor.parameters()]
    told = learner._update(learner._prepare()[0])
    assert told["Policy/step_share"] == 0.0 and told["Policy/kl"].abs() < 1e-6
    assert same(before, [p.detach() for p in learner.policy.actor.parameters()])


@pytest.mark.parametrize("heads", [1, 2])
def test_fisher_products_are_those_of_the_hessian_of_the_kl(heads: int):
    g = torch.Generator().manual_seed(0)
    actor = GaussianActor(Inputs(plain_groups(3, 2)), (4,), 2, 0.5, g, "tanh", heads).double()
    one_hot = torch.eye(2, dtype=torch.float64)[torch.tensor([0, 1, 0, 1, 1])]
    obs = torch.cat([torch.randn(5, 1, generator=g, dtype=torch.float64), one_hot], dim=1)
    parameters = list(actor.parameters())
    names, shapes = [n for n, _ in actor.named_parameters()], [p.shape for p in parameters]
    mean_p, log_std_p = actor(obs).detach(), actor.log_std_of(obs).detach()

    def kl_at(vector: Tensor) -> Tensor:
        parts = vector.split([p.numel() for p in parameters])
        values = {n: v.view(s) for n, v, s in zip(names, parts, shapes, strict=True)}
        mean = torch.func.functional_call(actor, values, (obs,))
        rows = values["log_std"] if heads == 1 else one_hot @ values["log_std"]
        return gaussian_kl(mean_p, log_std_p, mean, rows).mean()

    start = flatten(parameters).detach()
    hessian = torch.autograd.functional.hessian(kl_at, start)
    assert isinstance(hessian, Tensor)
    kl = gaussian_kl(mean_p, log_std_p, actor(obs), actor.log_std_of(obs)).mean()
    product = fisher_product(kl, parameters, damping=0.3)
    v = torch.randn(len(start), generator=g, dtype=torch.float64)
    assert_close(product(v), hessian @ v + 0.3 * v)

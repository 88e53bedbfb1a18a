from dataclasses import replace

import pytest
import torch
from torch.distributions import Independent, Normal, kl_divergence
from torch.testing import assert_close

from bidex_algos.onpolicy.mttrpo import MTTRPO, MTTRPOConfig
from bidex_algos.rollout import collect
from tests.algos.ranks import same
from tests.algos.toy import ToyWorld, nearness

SMALL = MTTRPOConfig(hidden=(32, 32), rollout_steps=8, std_range=(0.2, 1.0), fisher_stride=1, max_kl=0.03)


def ready(config: MTTRPOConfig, world: ToyWorld) -> MTTRPO:
    learner = MTTRPO(world, config, seed=0)
    learner.iterate()
    assert learner.obs is not None
    collect(world, learner.rollout, learner.obs, learner._sample, learner._final_value, learner.episodes)
    return learner


@pytest.mark.parametrize("max_kl", [0.003, 0.03, 0.3])
@pytest.mark.parametrize("policy_heads", [False, True])
def test_the_kl_after_the_step_is_kept_and_nearly_used(max_kl: float, policy_heads: bool):
    learner = ready(replace(SMALL, max_kl=max_kl, policy_heads=policy_heads), ToyWorld([nearness(0.6), nearness(-0.6)]))
    obs = learner.rollout.obs.flatten(0, 1)
    before = [part.clone() for part in learner.policy.distribution(obs)]
    told = learner._update(learner._prepare()[0])["Policy/kl"]
    after = learner.policy.distribution(obs)
    p, q = (Independent(Normal(mean, log_std.exp().expand(mean.shape)), 1) for mean, log_std in (before, after))
    kl = kl_divergence(p, q).mean()
    assert 0.3 * max_kl < kl <= max_kl * (1 + 1e-5)
    assert_close(told.float(), kl, rtol=1e-3, atol=1e-6)


def test_the_fisher_matrix_is_made_of_samples_of_all_rows():
    world = ToyWorld([nearness(0.6), nearness(-0.6)], rows=4)
    learner = ready(replace(SMALL, rollout_steps=8, fisher_stride=4), world)
    batch, _ = learner._prepare()
    weights = list(learner.policy.actor.parameters())
    for row in range(4):  # with weight in this row alone there is still a curvature
        batch.weights = (torch.arange(len(batch.obs)) % 4 == row).float()
        slope = torch.autograd.grad(learner._kl_from_itself(batch), weights, create_graph=True, materialize_grads=True)
        along = sum((s * torch.ones_like(s)).sum() for s in slope)
        curved = torch.autograd.grad(along, weights, allow_unused=True)
        assert sum(float(c.abs().sum()) for c in curved if c is not None) > 0


def test_it_learns_with_hidden_layers_in_bfloat16():
    learner = MTTRPO(ToyWorld([nearness(0.6)]), replace(SMALL, autocast="on"), seed=0)
    assert learner.iterate()["Policy/kl"] <= 0.031


def test_a_step_that_the_line_search_refuses_leaves_the_policy_alone():
    learner = ready(replace(SMALL, accept_ratio=1.0, backtracks=1, max_kl=1.0), ToyWorld([nearness(0.6)]))
    before = [p.detach().clone() for p in learner.policy.actor.parameters()]
    told = learner._update(learner._prepare()[0])
    assert told["Policy/step_share"] == 0.0 and told["Policy/kl"].abs() < 1e-6
    assert same(before, [p.detach() for p in learner.policy.actor.parameters()])

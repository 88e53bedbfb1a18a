from dataclasses import replace
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from bidex_algos.nets.networks import gaussian_log_prob
from bidex_algos.onpolicy.mtppo import MTPPO, MTPPOConfig
from bidex_algos.onpolicy.mttrpo import MTTRPO, MTTRPOConfig
from bidex_algos.rollout import collect
from bidex_meta.errors import BidexError
from tests.algos.problems import trained
from tests.algos.toy import ToyWorld, nearness

SMALL = MTPPOConfig(
    hidden=(32, 32), rollout_steps=8, learning_rate_range=(1e-5, 2e-3), std_range=(0.05, 1.0), autocast="off"
)


@pytest.mark.parametrize(("terminal", "value"), [(False, 5.0), (True, 1.0)])
def test_a_time_limit_is_bootstrapped_and_a_true_end_is_not(terminal: bool, value: float):
    # Reward 1 at each step and gamma 0.8: worth 1 / (1 - 0.8) = 5 where only the clock stops an episode of one step.
    world = ToyWorld([lambda action: torch.ones(len(action))], horizon=1, terminal=terminal)
    learner = MTPPO(world, replace(SMALL, gamma=0.8, critic_learning_rate=3e-3), seed=0)
    for _ in range(60):
        learner.iterate()
    obs, _ = world.reset(seed=1)
    assert_close(learner._final_value(obs, world.task_id), torch.full((32,), value), rtol=0.05, atol=0)


@pytest.mark.parametrize("autocast", ["off", "on"])
def test_the_first_ratio_is_one(autocast: str):
    world = ToyWorld([nearness(0.6)], rows=37, actions=20)
    learner = MTPPO(world, replace(SMALL, autocast=autocast), seed=0)
    for _ in range(3):
        learner.iterate()
    obs = learner.obs
    assert obs is not None
    collect(world, learner.rollout, obs, learner._sample, learner._final_value, learner.episodes)
    batch, _ = learner._prepare()
    part = batch.select(torch.randperm(len(batch.obs))[:50])
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=learner.low_precision):
        mean = learner.policy.actor(part.obs)
    log_prob = gaussian_log_prob(part.actions, mean, learner.policy.actor.log_std)
    assert_close(torch.exp(log_prob - part.old_log_probs), torch.ones(50), rtol=0, atol=1e-3)


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


def test_fewer_samples_than_mini_batches_are_refused():
    with pytest.raises(BidexError, match="num_envs"):
        MTPPO(ToyWorld([nearness(0.6)], rows=1), replace(SMALL, rollout_steps=1), seed=0)


def test_an_untrained_critic_makes_no_statistics_of_returns():
    world = ToyWorld([nearness(0.6, scale=1e-3), nearness(-0.3)])
    learner = MTPPO(world, replace(SMALL, per_task_values=True), seed=0)
    learner.iterate()
    small, large = learner.return_stats.std().tolist()
    assert small < 0.01 and large > 0.1

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from bidex_algos.nets.networks import gaussian_log_prob
from bidex_algos.onpolicy.mtppo import MTPPO, MTPPOConfig
from bidex_algos.rollout import collect
from bidex_meta.errors import BidexError
from tests.algos.toy import ToyWorld, nearness

SMALL = MTPPOConfig(
    hidden=(32, 32), rollout_steps=8, learning_rate_range=(1e-5, 2e-3), std_range=(0.05, 1.0), autocast="off"
)


def mean_errors(learner: MTPPO, world: ToyWorld, targets: list[float]) -> list[float]:
    """Distance of the mean action from each task's target."""
    obs, _ = world.reset(seed=1)
    action = learner.eval_action(obs)
    return [float((action[world.task_id == k] - t).abs().max()) for k, t in enumerate(targets)]


def test_surgery_between_tasks_that_agree_changes_nothing_but_rounding():
    world = ToyWorld([nearness(0.4), nearness(0.4)])
    gradients = []
    for surgery in ("none", "pcgrad"):
        learner = MTPPO(world, replace(SMALL, gradient_surgery=surgery, num_minibatches=1), seed=0)
        learner.iterate()
        batch, _ = learner._prepare()
        batch.obs[:, 1:] = 0.5  # the same observation and the same advantages in both tasks
        batch.obs[:, 0], batch.advantages[:] = 0.0, batch.actions[:, 0]
        learner._gradients(batch, batch.weights.sum(), learner.policy.actor.log_std.detach().clone())
        gradients.append(torch.cat([p.grad.flatten() for p in learner.policy.actor.parameters()]))
    assert gradients[0].norm() > 0
    assert_close(*gradients)


def test_without_normalisation_per_task_the_small_task_is_lost():
    world = ToyWorld([nearness(0.4), nearness(-0.4, scale=1000.0)])
    raw = replace(SMALL, per_task_advantages=False, per_task_values=False, clip_apart=False)
    learner = MTPPO(world, raw, seed=0)
    for _ in range(60):
        learner.iterate()
    assert mean_errors(learner, world, [0.4, -0.4])[0] > 0.3


@pytest.mark.parametrize(("terminal", "value"), [(False, 5.0), (True, 1.0)])
def test_a_time_limit_is_bootstrapped_and_a_true_end_is_not(terminal: bool, value: float):
    # Reward 1 at each step and gamma 0.8: worth 1 / (1 - 0.8) = 5 where only the clock stops an episode of one step.
    world = ToyWorld([lambda action: torch.ones(len(action))], horizon=1, terminal=terminal)
    learner = MTPPO(world, replace(SMALL, gamma=0.8, critic_learning_rate=3e-3), seed=0)
    for _ in range(60):
        learner.iterate()
    obs, _ = world.reset(seed=1)
    assert_close(learner._final_value(obs, world.task_id), torch.full((32,), value), rtol=0.05, atol=0)


def test_a_broken_transition_cuts_the_trace_but_keeps_the_value_before_it():
    world = ToyWorld([nearness(0.6)], horizon=100, unstable=((5, 3),))
    learner = MTPPO(world, replace(SMALL, per_task_advantages=False), seed=0)
    learner.iterate()
    batch, _ = learner._prepare()
    weights = batch.weights.view(8, 32)
    assert weights[5, 3] == 0 and weights.sum() == 8 * 32 - 1
    assert batch.advantages.view(8, 32)[5, 3] == 0


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


@pytest.mark.parametrize("desired_kl", [1e-6, 1e6])
def test_an_update_moves_the_step_size_towards_the_desired_kl(desired_kl: float):
    learner = MTPPO(ToyWorld([nearness(0.6)]), replace(SMALL, desired_kl=desired_kl, learning_rate=1e-3), seed=0)
    metrics = learner.iterate()
    assert (metrics["Policy/lr"] < 1e-3) == (metrics["Policy/kl"] > desired_kl)
    assert metrics["Policy/lr"] != 1e-3


def test_the_standard_deviation_keeps_its_bounds():
    learner = MTPPO(ToyWorld([nearness(0.6)]), replace(SMALL, std_range=(0.79, 0.81)), seed=0)
    for _ in range(10):
        learner.iterate()
    std = learner.policy.actor.log_std.exp()
    assert std.min() > 0.789
    assert std.max() < 0.811


def test_fewer_samples_than_mini_batches_are_refused():
    with pytest.raises(BidexError, match="num_envs"):
        MTPPO(ToyWorld([nearness(0.6)], rows=1), replace(SMALL, rollout_steps=1), seed=0)


def test_an_untrained_critic_makes_no_statistics_of_returns():
    """Rewards near 0.001: what the critic says at first, numbers about 1, would make their deviation."""
    world = ToyWorld([nearness(0.6, scale=1e-3), nearness(-0.3)])
    learner = MTPPO(world, replace(SMALL, per_task_values=True), seed=0)
    learner.iterate()
    small, large = learner.return_stats.std().tolist()
    assert small < 0.01 and large > 0.1

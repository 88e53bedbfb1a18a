from dataclasses import replace

import pytest
import torch
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution
from torch.testing import assert_close

from bidex_algos.offpolicy.mtsac import MTSAC, MTSACConfig
from bidex_meta.errors import BidexError
from tests.algos.problems import OFF_POLICY, one_step_bandit, opposite_bandits
from tests.algos.toy import ToyWorld, nearness

SMALL = MTSACConfig(**OFF_POLICY, critic_layer_norm=False, init_alpha=0.01)


def density(learner: MTSAC, obs: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    mean, log_std = (x.detach().double() for x in learner.policy.actor(obs))
    squashed = Independent(TransformedDistribution(Normal(mean, log_std.exp()), TanhTransform(cache_size=1)), 1)
    action = torch.tanh(mean + log_std.exp() * noise.double())
    raw = Normal(mean, log_std.exp()).log_prob(mean + log_std.exp() * noise.double())
    log_prob = (raw - (1 - action.square()).log()).sum(1)
    assert_close(squashed.log_prob(action), log_prob, rtol=1e-4, atol=1e-4)
    return action, log_prob


def test_the_critics_target_is_that_of_the_definition():
    world = ToyWorld([nearness(0.5), nearness(-0.5)], rows=3)
    config = replace(SMALL, gamma=0.7, batch_per_task=3, init_alpha=0.3, cut_share=1.0)
    learner = MTSAC(world, config, seed=0)
    with torch.no_grad():
        learner.log_alpha[1] = 0.4  # temperatures that differ
        for weight in learner.target_critic.parameters():
            weight.add_(0.05 * torch.randn(weight.shape, generator=torch.Generator().manual_seed(3)))
    learner.returns.stats.mean.copy_(torch.tensor([0.0, 10.0]))
    learner.returns.stats.var.copy_(torch.tensor([4.0, 0.0]))
    first, following, final = torch.randn(3, 6, 3, generator=torch.Generator().manual_seed(1))
    learner.policy.observations.update(10 * first)
    reward = torch.arange(6.0) + 1
    terminated = torch.tensor([False, True, False, False, True, False])
    truncated = torch.tensor([False, False, True, False, True, True])
    learner.replay.begin(first)
    info = {"final_obs": final, "unstable": torch.zeros(6, dtype=torch.bool)}
    learner.replay.add(torch.zeros(6, 2), reward, terminated, truncated, following, info)

    draw = learner.replay.take(torch.arange(6))
    generator = torch.Generator()
    generator.set_state(learner.generator.get_state())
    target = learner._target(draw, learner.policy.observations(draw.next_obs))

    true_next = torch.where((truncated & ~terminated)[:, None], final, following)
    obs = learner.policy.observations(true_next)
    action, log_prob = density(learner, obs, torch.randn(6, 2, generator=generator))
    q = torch.stack([net(torch.cat([obs, action.float()], 1)) for net in learner.target_critic.nets])
    q = torch.cat([q[:, :3, 0], q[:, 3:, 1]], 1).amin(0).double()
    alpha = torch.tensor([0.3] * 3 + [float(torch.tensor(0.4).exp())] * 3)
    scaled = reward / torch.tensor([2.0] * 3 + [1.0] * 3)
    expected = scaled + 0.7 * (~terminated) * (q - alpha * log_prob).detach()
    assert_close(target.double(), expected.double(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("target", [-2.0, 0.2])
def test_the_policy_comes_to_the_entropy_asked_for(target: float):
    config = replace(SMALL, target_entropy_per_action=target, alpha_learning_rate=2e-2)
    learner = MTSAC(one_step_bandit(0.3), config, seed=0)
    entropies = [learner.iterate().get("Policy/entropy", 0.0) for _ in range(14)]
    assert sum(entropies[-4:]) / 4 == pytest.approx(2 * target, abs=1.2)


def test_uniform_actions_come_first_and_teach_nothing_yet():
    learner = MTSAC(one_step_bandit(), replace(SMALL, warmup_steps=8, cut_share=1.0), seed=0)
    before = [p.detach().clone() for p in [*learner.policy.parameters(), *learner.critic.parameters()]]
    learner.iterate()
    actions = learner.replay._steps["actions"][:8]
    assert_close(actions.abs().mean(), torch.tensor(0.5), rtol=0.1, atol=0)
    assert_close(actions.abs().max(), torch.tensor(1.0), rtol=0.02, atol=0)
    metrics = learner.iterate()
    assert "Loss/critic" in metrics
    after = [*learner.policy.parameters(), *learner.critic.parameters()]
    assert all((a != b).any() for a, b in zip(before, after, strict=True))


def test_rewards_are_scaled_by_the_deviation_of_discounted_returns():
    learner = MTSAC(ToyWorld([nearness(0.0)], rows=3, horizon=10), replace(SMALL, gamma=0.5), seed=0)
    rewards = torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [-1.0, 0.0, 1.0]])
    ended = torch.tensor([[False, True, False], [False] * 3, [False] * 3])
    for r, e in zip(rewards, ended, strict=True):
        learner.returns.note(r, e, torch.zeros(3).bool(), torch.zeros(3).bool())
    returns = torch.tensor([[1.0, 2.0, 3.0], [4.5, 5.0, 7.5], [1.25, 2.5, 4.75]]).double()
    scale = (returns.var(correction=0) + (0.1 * returns.mean()).square()).sqrt()
    assert_close(learner._reward_scale().double(), scale[None], rtol=1e-5, atol=0)
    assert torch.equal(learner.returns.discounted.double(), returns[2])


def test_the_replay_is_cut_to_its_memory_and_says_so(capsys: pytest.CaptureFixture[str]):
    MTSAC(one_step_bandit(), replace(SMALL, replay_steps=1000), seed=0)
    assert capsys.readouterr().err == ""
    learner = MTSAC(one_step_bandit(), replace(SMALL, replay_steps=1000, replay_memory=1e-4), seed=0)
    line = capsys.readouterr().err
    steps = learner.replay.steps
    assert 50 < steps < 200
    assert line.count("\n") == 1
    for part in ("1,000 vector steps (32,000 transitions)", "0.0001 GB", f"keeps {steps:,} ({steps * 32:,} tr"):
        assert part in line
    with pytest.raises(BidexError, match="replay_memory 1e-06 GB holds not one step of 32 environments"):
        MTSAC(one_step_bandit(), replace(SMALL, replay_memory=1e-6), seed=0)


def test_a_batch_is_split_evenly_over_the_tasks():
    world = opposite_bandits()
    assert MTSAC(world, replace(SMALL, batch_size=101), seed=0).batch_per_task == 51
    assert MTSAC(world, replace(SMALL, batch_per_task=7), seed=0).batch_per_task == 7


def test_a_task_without_environments_is_refused():
    world = opposite_bandits()
    world.task_id = torch.zeros_like(world.task_id)
    with pytest.raises(BidexError, match="task1 has no environments"):
        MTSAC(world, SMALL, seed=0)

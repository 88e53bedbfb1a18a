"""The offline learners: problems with a known answer, parts against independent computations, resume."""

import os
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.stats
import torch
from torch.testing import assert_close

from bidex_algos.offline.bc import BC, BCConfig
from bidex_algos.offline.bcq import BCQ, BCQConfig
from bidex_algos.offline.iql import IQL, IQLConfig
from bidex_algos.offline.td3bc import TD3BC, TD3BCConfig
from bidex_meta.data.joined import Joined
from bidex_meta.errors import BidexError
from bidex_meta.training.learner import Sources
from tests.algos.problems import PointMass, discounted_return, one_step_bandit, opposite_bandits
from tests.offline.against_d3rlpy import against
from tests.offline.stored import as_data, noisy, played

PLAIN: dict[str, Any] = {
    "hidden": (32, 32), "batch_size": 128, "updates_per_iteration": 200, "learning_rate": 3e-3, "autocast": "off",
}  # fmt: skip
VALUED: dict[str, Any] = {
    **PLAIN, "critic_learning_rate": 5e-3, "gamma": 0.8, "tau": 0.02, "critic_layer_norm": False,
}  # fmt: skip
SMALL: dict[str, tuple[Any, Any]] = {
    "bc": (BC, BCConfig(**PLAIN)),
    "td3bc": (TD3BC, TD3BCConfig(**VALUED)),
    "iql": (IQL, IQLConfig(**VALUED)),
    "bcq": (BCQ, BCQConfig(**VALUED, vae_hidden=(32, 32), perturbation=0.2)),
}
each = pytest.mark.parametrize("name", SMALL)
valued = pytest.mark.parametrize("name", ["td3bc", "iql", "bcq"])


def learned(name: str, world: Any, data: Joined, iterations: int, **options: Any) -> Any:
    kind, config = SMALL[name]
    learner = kind(world, replace(config, **options), 0, Sources(data))
    for _ in range(iterations):
        learner.iterate()
    return learner


def bad_bandit() -> tuple[Any, Joined]:
    world = one_step_bandit(0.6)
    return world, as_data(played(world, noisy(lambda obs: torch.full((len(obs), 2), -0.2), 0.4), 40))


@pytest.fixture(scope="module")
def point() -> tuple[Joined, float]:
    """A point mass that goes to its goal with a constant error and noise, and the return of that without the noise."""
    world = PointMass()
    behaviour = noisy(world.best, 0.5, 0.4)
    return as_data(played(world, behaviour, 200)), discounted_return(PointMass(256), noisy(world.best, 0, 0.4), 0.8, 20)


def test_bc_does_on_the_bandit_what_the_data_did() -> None:
    world, data = bad_bandit()
    action = learned("bc", world, data, 2).eval_action(world.reset(seed=1)[0])
    assert_close(action.mean(0), data.actions.mean(0), atol=0.05, rtol=0)


@valued
def test_the_others_do_better_on_the_bandit_than_the_data(name: str) -> None:
    world, data = bad_bandit()
    action = learned(name, world, data, 2).eval_action(world.reset(seed=1)[0])
    least = {"td3bc": 0.25, "iql": 0.1, "bcq": -0.13}[name]  # BCQ keeps near what its model proposes
    assert float(action.mean()) > least > float(data.actions.mean())


@each
def test_point_mass(name: str, point: tuple[Joined, float]) -> None:
    data, behaviour = point
    learner, best = learned(name, PointMass(), data, 4), discounted_return(PointMass(256), PointMass().best, 0.8, 20)
    found = discounted_return(PointMass(256), learner.eval_action, 0.8, 20)
    if name == "bc":
        assert abs(found - behaviour) < 0.1
    else:
        assert best > found > behaviour + 0.08


def test_one_policy_of_two_tasks_at_odds_tells_them_apart() -> None:
    world = opposite_bandits(0.5, scale=1000.0)
    sign = 1.0 - 2.0 * world.task_id[:, None].float()
    data = as_data(played(world, noisy(lambda obs: 0.2 * sign.expand(-1, 2), 0.4), 40))
    learner = learned("iql", world, data, 2)
    action = learner.eval_action(world.reset(seed=1)[0])
    first, second = (float(action[world.task_id == task].mean()) for task in (0, 1))
    assert first > 0.25 and second < -0.25
    assert 500 < float(learner.reward_scale[1] / learner.reward_scale[0]) < 2000


def test_without_a_value_td3bc_is_bc() -> None:
    world, data = bad_bandit()
    bc = learned("bc", world, data, 2)
    still = learned("td3bc", world, data, 2, alpha=0.0, policy_delay=1)
    own, same = (each.policy.actor.state_dict() for each in (bc, still))
    assert all(torch.equal(own[name], same[name]) for name in own)


def test_iql_finds_expectile_and_weighted_mean_of_a_bandit() -> None:
    world, data = bad_bandit()
    learner = learned("iql", world, data, 5, learning_rate=1e-3, critic_learning_rate=2e-3)
    obs, _ = world.reset(seed=1)
    rewards = (data.rewards / learner.reward_scale).double().numpy()
    expectile = scipy.stats.expectile(rewards, 0.7)
    assert abs(float(learner._worth(learner.policy.observations(obs)).detach().mean()) - expectile) < 0.1
    weights = np.minimum(np.exp(3.0 * (rewards - expectile)), 100.0)
    wanted = (weights[:, None] * data.actions.numpy()).sum(0) / weights.sum()
    assert_close(learner.eval_action(obs).mean(0), torch.from_numpy(wanted).float(), atol=0.08, rtol=0)


def test_td3bc_actor_loss_by_hand() -> None:
    world, data = bad_bandit()
    learner = learned("td3bc", world, data, 1)
    obs = learner.policy.observations(data.observations[data.at[:128]])
    actions = learner.policy.actor(obs)
    imitation = ((actions - data.actions[:128]) ** 2).mean()
    loss, _ = learner._actor_loss(imitation, obs, actions)
    values = learner.critic.nets[0](torch.cat([obs, actions], 1))[:, 0]
    by_hand = imitation - 2.5 * values.sum() / values.abs().sum()
    assert_close(loss, by_hand)


def test_bcq_acts_as_a_loop_over_candidates_and_changes_them_little(point: tuple[Joined, float]) -> None:
    learner = learned("bcq", PointMass(), point[0], 1)
    policy, raw = learner.policy, point[0].observations[:5]
    with torch.no_grad():
        for row, action in zip(raw, learner.eval_action(raw), strict=True):
            obs, tried = policy.observations(row[None]), []
            for code in policy.codes:
                proposed = torch.tanh(policy.model.decoder(torch.cat([obs[0], code])[None]))
                step = 0.2 * torch.tanh(policy.actor.net(torch.cat([obs, proposed], 1)))
                assert step.abs().max() <= 0.2
                changed = (proposed + step).clamp(-1, 1)
                tried.append((float(policy.critic.nets[0](torch.cat([obs, changed], 1))), changed[0]))
            assert_close(action, max(tried, key=lambda pair: pair[0])[1])
    assert policy.codes.abs().max() <= 0.5


def test_bcq_target_and_divergence_against_plain_ones(point: tuple[Joined, float]) -> None:
    learner = learned("bcq", PointMass(), point[0], 1, kl_weight=1.0)
    draw = learner._batches.take(learner._batches.draw(1, torch.Generator().manual_seed(0))[0])
    obs, next_obs = learner.policy.observations(draw.obs), learner.policy.observations(draw.next_obs)
    learner.noise.manual_seed(5)
    target = learner._target(draw, next_obs)
    noise = torch.randn(1280, 4, generator=torch.Generator().manual_seed(5)).clamp(-0.5, 0.5).view(128, 10, 4)
    with torch.no_grad():
        for row in range(3):
            best = -np.inf
            for code in noise[row]:
                action = torch.tanh(learner.policy.model.decoder(torch.cat([next_obs[row], code])[None]))
                action = action + 0.2 * learner.target_actor(torch.cat([next_obs[row][None], action], 1))
                x = torch.cat([next_obs[row][None], action.clamp(-1, 1)], 1)
                values = [float(net(x)) for net in learner.target_critic.nets]
                best = max(best, 0.75 * min(values) + 0.25 * max(values))
            assert float(target[row]) == pytest.approx(
                float(draw.rewards[row] / learner.reward_scale[0]) + 0.8 * best, abs=1e-4
            )
        mean, log_std = learner.policy.model.encode(obs, draw.actions)
    normal = torch.distributions.Normal
    divergence = torch.distributions.kl_divergence(normal(mean, log_std.exp()), normal(0.0, 1.0)).mean()
    assert_close(learner._fit_model(obs, draw.actions)["Loss/divergence"], divergence)


@pytest.mark.parametrize("name", ["td3bc", "bcq"])
def test_targets_begin_as_the_policy_to_start_from(name: str) -> None:
    world, data = bad_bandit()
    kind, config = SMALL[name]
    learner = kind(world, config, 1, Sources(data))
    learner.start_from(learned(name, world, data, 1).policy_state_dict())
    pairs = [(learner.target_actor, learner.policy.actor)]
    if name == "bcq":
        pairs.append((learner.target_critic, learner.policy.critic))
    for target, network in pairs:
        for ours, given in zip(target.parameters(), network.parameters(), strict=True):
            assert torch.equal(ours, given)


def test_iql_acts_with_the_deviation_that_it_reports() -> None:
    world, data = bad_bandit()
    learner = learned("iql", world, data, 3, init_std=0.3, std_range=(0.29, 0.31))
    acting = float(learner.policy.actor.log_std.detach().exp().mean())
    assert 0.2899 < acting < 0.3101 and learner.iterate()["Policy/std"] == pytest.approx(acting, abs=0.02)


def test_a_checkpoint_of_other_data_is_refused() -> None:
    world, data = bad_bandit()
    learner = learned("iql", world, data, 1)
    other = IQL(world, SMALL["iql"][1], 0, Sources(replace(data, rewards=data.rewards + 1.0)))
    with pytest.raises(BidexError, match="data sets have rewards"):
        other.load_state_dict(learner.state_dict())
    with pytest.raises(BidexError, match="bc: has no data to learn from"):
        BC(world, SMALL["bc"][1], seed=0)
    with pytest.raises(BidexError, match="bc: does not learn from demonstrations"):
        BC(world, SMALL["bc"][1], 0, Sources(data, demonstrations=data))


PYTHON = os.environ.get("D3RLPY_PYTHON")


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.skipif(not PYTHON, reason="D3RLPY_PYTHON names no interpreter with d3rlpy")
def test_the_intervals_of_three_seeds_overlap() -> None:
    world = PointMass()
    data = as_data(played(world, noisy(world.best, 0.5, 0.4), 200))
    found = against(
        data, world, lambda agent: discounted_return(PointMass(rows=1024), agent.eval_action, 0.99, 20), str(PYTHON),
        updates=3000
    )  # fmt: skip
    behaviour = discounted_return(PointMass(rows=1024), noisy(world.best, 0.0, 0.4), 0.99, 20)
    print(found, behaviour, torch.get_num_threads())
    for algo, told in found.items():
        assert told["overlap"], algo
        assert min(told["theirs"] + told["ours"]) > behaviour, algo

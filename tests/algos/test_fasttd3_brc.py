"""FastTD3 and BRC: known optima, targets by hand, resume; what they are made of is in ``test_categorical.py``."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from bidex_algos.offpolicy.brc import BRC, BRCConfig
from bidex_algos.offpolicy.fasttd3 import FastTD3, FastTD3Config
from bidex_algos.replay import Transitions
from bidex_meta.train import distributed
from tests.algos.problems import LQR, OFF_POLICY, opposite_bandits, trained
from tests.algos.ranks import in_two_processes, same
from tests.algos.test_categorical import slow_projection
from tests.algos.toy import ToyWorld, nearness

SHARED = OFF_POLICY | {"critic_hidden": (32, 32), "updates_per_step": 2, "tau": 0.1, "atoms": 51}
FAST = FastTD3Config(**SHARED | {"updates_per_step": 4}, critic_layer_norm=False, n_steps=1, squash_price=0.0)
SMALL = BRCConfig(**SHARED, n_steps=1, task_embedding=4, init_alpha=0.01, target_entropy_per_action=-2.0)
both = pytest.mark.parametrize(("kind", "config"), [(FastTD3, FAST), (BRC, SMALL)], ids=["fasttd3", "brc"])


def a_draw() -> Transitions:
    generator = torch.Generator().manual_seed(1)
    obs, following = torch.randn(2, 6, 3, generator=generator)
    ends, steps = torch.tensor([False, True, False, False, True, False]), torch.tensor([1, 2, 3, 1, 1, 3])
    return Transitions(obs, torch.zeros(6, 2), torch.arange(6.0) - 3, following, ends, steps)


def shaken(learner: Any) -> None:
    noise = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for weight in learner.target_critic.parameters():
            weight.add_(0.3 * torch.randn(weight.shape, generator=noise))


def distributions(learner: Any, obs: Tensor, actions: Tensor) -> Tensor:
    x = torch.cat([obs, actions], dim=1)
    return torch.stack([net(x).detach().double().softmax(1) for net in learner.target_critic.nets])


def projected(learner: Any, draw: Transitions, rewards: Tensor, following: Tensor, bonus: Tensor) -> Tensor:
    rows = []
    for i in range(6):
        factor = 0.0 if draw.terminated[i] else 0.7 ** int(torch.as_tensor(draw.steps)[i])
        shift = float(rewards[i]) + factor * float(bonus[i])
        rows.append(slow_projection(-10.0, 10.0, following[i].numpy(), shift, factor))
    return torch.from_numpy(np.stack(rows))


TWO: dict[str, Any] = {"gamma": 0.7, "batch_per_task": 3, "cut_share": 1.0}


@pytest.mark.parametrize("lower", [True, False])
def test_fasttd3s_target_is_that_of_the_definition(lower: bool) -> None:
    world = ToyWorld([nearness(0.5), nearness(-0.5)], rows=3)
    learner, draw = FastTD3(world, replace(FAST, **TWO, clipped_double_q=lower), seed=0), a_draw()
    with torch.no_grad():  # away from whatever was copied of it
        next(learner.policy.actor.parameters()).mul_(3.0)
    shaken(learner)
    learner.returns.stats.var.copy_(torch.tensor([4.0, 0.25]))
    learner.returns.bound.copy_(torch.tensor([1.0, 50.0]))  # deviation 2 counts, and 50 / 10
    again = learner.generator.clone_state()
    target = learner._target(draw, draw.next_obs)
    noise = (0.2 * torch.randn(6, 2, generator=again)).clamp(-0.5, 0.5)
    actions = (learner.policy.actor(draw.next_obs) + noise).clamp(-1, 1)
    probs = distributions(learner, draw.next_obs, actions.detach())
    means = (probs * torch.linspace(-10, 10, 51).double()).sum(2)
    choice = (means[1] < means[0]).long()
    assert 0 < choice.sum() < 6
    following = probs[choice, torch.arange(6)] if lower else probs.mean(0)
    rewards = draw.rewards / torch.tensor([2.0] * 3 + [5.0] * 3)
    expected = projected(learner, draw, rewards, following, torch.zeros(6))
    assert_close(target.double(), expected, rtol=1e-4, atol=1e-5)


def test_an_older_fasttd3_checkpoint_still_loads() -> None:
    learner, again = (FastTD3(opposite_bandits(rows=6), FAST, seed=seed) for seed in (0, 1))
    state = learner.state_dict()
    assert "target_actor" not in state
    del state["recent"]
    again.load_state_dict(state | {"target_actor": again.policy.actor.state_dict()})
    assert same(again.policy.state_dict(), learner.policy.state_dict())


def test_brcs_target_is_that_of_the_definition() -> None:
    world = ToyWorld([nearness(0.5), nearness(-0.5)], rows=3)
    learner, draw = BRC(world, replace(SMALL, **TWO), seed=0), a_draw()
    shaken(learner)
    with torch.no_grad():
        learner.log_alpha.copy_(torch.tensor([0.1, 0.9]).log())
    learner.returns.bound.copy_(torch.tensor([4.0, 50.0]))
    again = learner.generator.clone_state()
    target = learner._target(draw, draw.next_obs)
    actions, log_prob = learner.policy.sample(draw.next_obs, again)
    following = distributions(learner, draw.next_obs, actions.detach()).mean(0)
    # An entropy of 2 actions times 2 at each step to come; of the second task more than half of the range.
    rooms = [10.0 - 0.1 * 4.0 / 0.3, 5.0]
    rewards = draw.rewards / torch.tensor([4.0 / rooms[0]] * 3 + [50.0 / rooms[1]] * 3)
    bonus = -torch.tensor([0.1] * 3 + [0.9] * 3) * log_prob.detach()
    assert_close(target.double(), projected(learner, draw, rewards, following, bonus), rtol=1e-4, atol=1e-5)


@both
def test_critics_go_down_their_cross_entropy(kind: Any, config: Any) -> None:
    learner, draw = kind(opposite_bandits(rows=6), replace(config, batch_per_task=3), seed=0), a_draw()
    target = torch.rand(6, 51, generator=torch.Generator().manual_seed(2)).softmax(1)
    losses, values = learner._critic_losses(draw.obs, draw.actions, target)
    x = torch.cat([draw.obs, draw.actions], dim=1)
    logs = torch.stack([net(x).double().log_softmax(1) for net in learner.critic.nets])
    assert_close(losses.double(), -(target * logs).sum(2), rtol=1e-4, atol=1e-5)
    assert_close(values.double(), (logs[0].exp() * torch.linspace(-10, 10, 51)).sum(1), rtol=1e-4, atol=1e-5)
    for _ in range(20):
        learner._fit_critics(draw.obs, draw, target, torch.ones(6), torch.full((2,), 3.0))
    assert learner._critic_losses(draw.obs, draw.actions, target)[0].sum() < losses.sum()


@pytest.mark.parametrize("one", [True, False])
def test_one_temperature_or_one_for_each_task(one: bool) -> None:
    learner = trained(BRC, opposite_bandits(rows=8), replace(SMALL, one_temperature=one), 2)
    first, second = learner.log_alpha.tolist()
    assert (first == second) == one and first != pytest.approx(torch.tensor(0.01).log().item())


@both
def test_weights_decay_but_no_temperature(kind: Any, config: Any) -> None:
    learner = kind(opposite_bandits(rows=6), replace(config, weight_decay=0.5), seed=0)
    decays = {name: adam.param_groups[0]["weight_decay"] for name, adam in learner.adams.items()}
    assert decays == {"actor": 0.5, "critic": 0.5} | ({"alpha": 0.0} if kind is BRC else {})
    before = [p.detach().clone() for p in learner.critic.parameters()]
    for p in learner.critic.parameters():
        p.grad = torch.zeros_like(p)
    learner.adams["critic"].step()
    for p, was in zip(learner.critic.parameters(), before, strict=True):
        assert_close(p.detach(), was * (1.0 - 0.5 * 5e-3))


def _bounds(rank: int) -> Tensor:
    distributed.init_from_environment()
    learner = BRC(opposite_bandits(rows=3 + rank, scale=10.0), replace(SMALL, batch_size=16), seed=0)
    learner.iterate()
    weights = torch.cat([p.detach().flatten() for p in learner.critic.parameters()])
    return torch.cat([learner.returns.bound, learner._reward_scale(), weights])


def test_processes_share_the_bound_and_the_networks(tmp_path: Path) -> None:
    one, other = in_two_processes(_bounds, tmp_path)
    assert torch.equal(one, other) and one[0] > 0.5


@both
def test_wide_critics_are_counted_as_memory(kind: Any, config: Any) -> None:
    wide = replace(config, critic_hidden=(4096, 4096, 4096))
    # Two critics of two more matrices of 4096 by 4096 each, with gradient and two moments, in float32.
    assert wide.bytes_held(64, 500) - config.bytes_held(64, 500) > 2 * 2 * 4096**2 * 4 * 4


def test_one_task_needs_no_embedding() -> None:
    assert LQR().num_id_columns == 0
    trained(BRC, LQR(rows=4), SMALL, 1)

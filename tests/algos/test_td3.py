"""DDPG and TD3, and with them the off-policy base: known optima, a target and the delay by hand, resume."""

import copy
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from bidex_algos.offpolicy.ddpg import DDPG, DDPGConfig, spread
from bidex_algos.offpolicy.td3 import TD3, TD3Config
from bidex_algos.replay import Transitions
from tests.algos.problems import opposite_bandits, trained
from tests.algos.toy import ToyWorld, nearness

SHARED: dict[str, Any] = {
    "hidden": (32, 32), "replay_steps": 200, "cut_share": 0.3, "warmup_steps": 4, "batch_size": 128,
    "critic_layer_norm": False, "gamma": 0.8, "tau": 0.05, "learning_rate": 3e-3, "critic_learning_rate": 5e-3,
    "squash_price": 0.0, "autocast": "off",
}  # fmt: skip
SMALL = TD3Config(**SHARED)
both = pytest.mark.parametrize(("kind", "config"), [(DDPG, DDPGConfig(**SHARED)), (TD3, SMALL)], ids=["ddpg", "td3"])


def a_draw() -> Transitions:
    generator = torch.Generator().manual_seed(1)
    obs, following = torch.randn(2, 6, 3, generator=generator)
    ends = torch.tensor([False, True, False, False, True, False])
    return Transitions(obs, torch.zeros(6, 2), torch.arange(6.0) + 1, following, ends)


def plain(net: Any, x: Tensor) -> Tensor:
    x = x.double()
    for layer in net.body:
        x = layer(x) if not hasattr(layer, "weight") else x @ layer.weight.double().T + layer.bias.double()
    return x @ net.head.weight.double().T + net.head.bias.double()


@both
def test_the_critics_target_is_that_of_the_definition(kind: Any, config: Any) -> None:
    world = ToyWorld([nearness(0.5), nearness(-0.5)], rows=3)
    config = replace(config, gamma=0.7, batch_per_task=3, cut_share=1.0, per_task_rewards=False)
    learner, draw = kind(world, config, seed=0), a_draw()
    noise = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for weight in [*learner.target_critic.parameters(), *learner.target_actor.parameters()]:
            weight.add_(0.3 * torch.randn(weight.shape, generator=noise))
    again = learner.generator.clone_state()
    target = learner._target(draw, draw.next_obs)
    action = plain(learner.target_actor.net, draw.next_obs).tanh()
    if kind is TD3:
        action = (action + (0.2 * torch.randn(6, 2, generator=again)).clamp(-0.5, 0.5)).clamp(-1, 1)
    judged = torch.cat([draw.next_obs.double(), action], dim=1)
    task = torch.tensor([0, 0, 0, 1, 1, 1])
    values = torch.stack([plain(net, judged)[torch.arange(6), task] for net in learner.target_critic.nets])
    assert len(values) == (2 if kind is TD3 else 1)
    expected = draw.rewards + 0.7 * values.amin(0) * ~draw.terminated
    assert_close(target.double(), expected.detach(), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_actor_and_targets_wait_for_the_critics(delay: int) -> None:
    learner = TD3(opposite_bandits(rows=6), replace(SMALL, policy_delay=delay, batch_per_task=3), seed=0)
    parts = [learner.policy.actor, learner.target_actor, learner.target_critic, learner.critic]
    moved = []
    for _ in range(2 * delay):
        before = [copy.deepcopy(list(part.parameters())) for part in parts]
        learner._update(a_draw(), torch.ones(6), torch.full((2,), 3.0))
        after = [list(part.parameters()) for part in parts]
        moved.append([not all(map(torch.equal, a, b)) for a, b in zip(before, after, strict=True)])
    waiting, due = [False, False, False, True], [True, True, True, True]
    assert moved == 2 * [*[waiting] * (delay - 1), due]


@both
def test_the_price_keeps_actions_from_their_corners(kind: Any, config: Any) -> None:
    def greedy(action: Tensor) -> Tensor:
        return 10.0 * action.sum(1)  # the more the better

    reached = []
    for price in (0.0, 1.0):
        learner = trained(kind, ToyWorld([greedy]), replace(config, squash_price=price), 6)
        reached.append(float(learner.eval_action(learner.replay.obs).mean()))
    assert reached[0] > 0.95 and 0.2 < reached[1] < 0.9


def test_noise_goes_from_little_to_much_over_the_rows_of_each_task() -> None:
    task_id = torch.tensor([0, 0, 0, 1, 2, 2])
    assert_close(spread(0.1, 0.5, task_id, 3), torch.tensor([0.1, 0.3, 0.5, 0.5, 0.1, 0.5]))

"""What every off-policy learner must do: known optima, time limits, checkpoints, metrics."""

import copy
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from bidex_algos.offpolicy.brc import BRC, BRCConfig
from bidex_algos.offpolicy.ddpg import DDPG, DDPGConfig, spread
from bidex_algos.offpolicy.fasttd3 import FastTD3, FastTD3Config
from bidex_algos.offpolicy.mtsac import MTSAC, MTSACConfig
from bidex_algos.offpolicy.td3 import TD3, TD3Config
from bidex_algos.replay import Transitions
from tests.algos.problems import LQR, OFF_POLICY, PointMass, discounted_return, errors, opposite_bandits, trained
from tests.algos.toy import ToyWorld, nearness

SHARED = OFF_POLICY
PLAIN: dict[str, Any] = SHARED | {"critic_layer_norm": False, "squash_price": 0.0}
ATOMS: dict[str, Any] = SHARED | {"critic_hidden": (32, 32), "atoms": 51, "tau": 0.1, "n_steps": 1}
SAC = MTSACConfig(**SHARED, critic_layer_norm=False, init_alpha=0.01)
FAST = FastTD3Config(**ATOMS, critic_layer_norm=False, squash_price=0.0)
LARGE = BRCConfig(
    **ATOMS, updates_per_step=2, task_embedding=4, init_alpha=0.01, target_entropy_per_action=-2.0
)  # fmt: skip
CASES: dict[str, tuple[Any, Any]] = {
    "ddpg": (DDPG, DDPGConfig(**PLAIN)), "td3": (TD3, TD3Config(**PLAIN)), "mtsac": (MTSAC, SAC),
    "fasttd3": (FastTD3, FAST), "brc": (BRC, LARGE),
}  # fmt: skip
each = pytest.mark.parametrize("name", CASES)


@each
@pytest.mark.parametrize("heads", [True, False])
def test_two_tasks_at_odds_are_learned_though_one_pays_a_thousandfold(name: str, heads: bool) -> None:
    kind, config = CASES[name]
    config = replace(config, policy_heads=heads, value_heads=heads)
    learner = trained(kind, opposite_bandits(0.5, scale=1000.0), config, 16 if name in ("ddpg", "td3") else 14)
    assert max(errors(learner, 0.5, -0.5)) < 0.15


@pytest.mark.parametrize(("name", "n_steps"), [*((name, 1) for name in CASES), ("fasttd3", 3), ("brc", 3)])
def test_lqr_comes_close_to_the_riccati_optimum(name: str, n_steps: int) -> None:
    kind, config = CASES[name]
    config = replace(config, n_steps=n_steps)
    if name == "mtsac":
        config = replace(config, target_entropy_per_action=-2.0, learning_rate=2e-3)
    learner, test = trained(kind, LQR(), config, 20 if name in ("fasttd3", "brc") else 22), LQR(rows=256)
    best = discounted_return(test, test.best(0.8), 0.8, 40)
    nothing = discounted_return(test, lambda obs: torch.zeros(len(obs), 2), 0.8, 40)
    assert nothing < 2.5 * best
    assert discounted_return(test, learner.eval_action, 0.8, 40) > 1.35 * best


@pytest.mark.parametrize("name", ["ddpg", "td3", "mtsac"])
def test_a_point_mass_reaches_its_goal(name: str) -> None:
    kind, config = CASES[name]
    config = replace(config, target_entropy_per_action=-2.0) if name == "mtsac" else config
    learner, test = trained(kind, PointMass(), config, 18), PointMass(rows=256)
    best = discounted_return(test, test.best, 0.8, 30)
    assert discounted_return(test, learner.eval_action, 0.8, 30) > 1.15 * best
    *_, info = test.step(torch.zeros(256, 2))
    assert name != "mtsac" or info["success"].float().mean() > 0.9


@each
@pytest.mark.parametrize(("terminal", "value"), [(False, 5.0), (True, 1.0)])
def test_a_time_limit_is_bootstrapped_and_a_true_end_is_not(name: str, terminal: bool, value: float) -> None:
    # Reward 1 at each step and gamma 0.8: worth 1 / (1 - 0.8) = 5 where only the clock stops an episode of one step.
    kind, config = CASES[name]
    world = ToyWorld([lambda action: torch.ones(len(action))], horizon=1, terminal=terminal)
    config = replace(config, cut_share=1.0, per_task_rewards=False, tau=0.1, updates_per_step=4)
    config = replace(config, init_alpha=1e-6) if name in ("mtsac", "brc") else config
    learner = trained(kind, world, config, 14)
    values = learner.critic(learner.policy.observations(learner.replay.obs), torch.zeros(32, 2), world.task_id)
    assert_close(values.detach(), torch.full_like(values, value), rtol=0.05, atol=0)


TD3_PLAIN = TD3Config(**PLAIN)
pair = pytest.mark.parametrize(("kind", "config"), [(DDPG, DDPGConfig(**PLAIN)), (TD3, TD3_PLAIN)], ids=["ddpg", "td3"])


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


@pair
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
    learner = TD3(opposite_bandits(rows=6), replace(TD3_PLAIN, policy_delay=delay, batch_per_task=3), seed=0)
    parts = [learner.policy.actor, learner.target_actor, learner.target_critic, learner.critic]
    moved = []
    for _ in range(2 * delay):
        before = [copy.deepcopy(list(part.parameters())) for part in parts]
        learner._update(a_draw(), torch.ones(6), torch.full((2,), 3.0))
        after = [list(part.parameters()) for part in parts]
        moved.append([not all(map(torch.equal, a, b)) for a, b in zip(before, after, strict=True)])
    waiting, due = [False, False, False, True], [True, True, True, True]
    assert moved == 2 * [*[waiting] * (delay - 1), due]


@pair
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

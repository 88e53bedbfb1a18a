"""What every off-policy learner must do: known optima, time limits, checkpoints, metrics."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from bidex_algos.offpolicy.brc import BRC, BRCConfig
from bidex_algos.offpolicy.ddpg import DDPG, DDPGConfig
from bidex_algos.offpolicy.fasttd3 import FastTD3, FastTD3Config
from bidex_algos.offpolicy.mtsac import MTSAC, MTSACConfig
from bidex_algos.offpolicy.td3 import TD3, TD3Config
from tests.algos.problems import LQR, PointMass, discounted_return, errors, opposite_bandits, trained
from tests.algos.toy import ToyWorld

SHARED: dict[str, Any] = {
    "hidden": (32, 32), "replay_steps": 200, "cut_share": 0.3, "warmup_steps": 4, "batch_size": 128, "gamma": 0.8,
    "tau": 0.05, "learning_rate": 3e-3, "critic_learning_rate": 5e-3, "autocast": "off",
}  # fmt: skip
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

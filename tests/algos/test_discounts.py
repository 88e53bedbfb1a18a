"""A discount for each class, from the suite's file to the learners, against computations by hand."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from bidex_algos.advantages import discounts, explained_variance
from bidex_algos.meta.promp import PRESETS as PROMP
from bidex_algos.meta.promp import ProMP
from bidex_algos.offpolicy.mtsac import MTSAC, MTSACConfig
from bidex_algos.offpolicy.td3 import TD3, TD3Config
from bidex_algos.onpolicy.mtppo import MTPPO, MTPPOConfig
from bidex_algos.onpolicy.mttrpo import MTTRPO, MTTRPOConfig
from bidex_meta.errors import BidexError
from tests.algos.families import PointClass, PointGoals
from tests.algos.toy import ToyWorld

PPO = MTPPOConfig(hidden=(16,), rollout_steps=8, gamma=0.8, critic_learning_rate=3e-3, autocast="off")
OFF: dict[str, Any] = {
    "hidden": (16,), "replay_steps": 60, "cut_share": 0.5, "warmup_steps": 4, "batch_size": 60, "gamma": 0.8,
    "autocast": "off",
}  # fmt: skip
KINDS: dict[str, tuple[Any, Any]] = {
    "ppo": (MTPPO, PPO),
    "trpo": (MTTRPO, MTTRPOConfig(hidden=(16,), rollout_steps=8, gamma=0.8)),
    "sac": (MTSAC, MTSACConfig(**OFF)),
    "td3": (TD3, TD3Config(**OFF)),
}
ON, REPLAYING = ("ppo", "trpo"), ("sac", "td3")
GAMMAS = (0.5, None, 0.9)  # the second class takes the learner's 0.8
OF_TASKS = torch.tensor([0.5, 0.8, 0.9])


def paying(gammas: tuple[float | None, ...] = GAMMAS, horizon: int = 3, **options: Any) -> ToyWorld:
    rewards = [lambda action: 1.0 + 0.1 * action[:, 0]] * len(gammas)
    world = ToyWorld(rewards, rows=5, horizon=horizon, **options)
    world.gammas = gammas
    return world


def test_a_world_without_discounts_leaves_the_number_as_it_is():
    world = paying((None, None, None))
    assert discounts(world, 0.93, world.task_id) == 0.93 and isinstance(discounts(world, 0.93, world.task_id), float)
    assert_close(discounts(paying(), 0.8, torch.tensor([2, 0, 1, 1])), torch.tensor([0.9, 0.5, 0.8, 0.8]))


@pytest.mark.parametrize("kind", ON)
@pytest.mark.parametrize("terminal", [False, True])
def test_advantages_and_targets_are_those_by_hand(kind: str, terminal: bool):
    make, config = KINDS[kind]
    world = paying(unstable=((3, 2), (5, 11)), terminal=terminal)
    learner = make(world, config, seed=0)
    learner.iterate()
    r = learner.rollout
    with torch.no_grad():
        obs = learner.policy.observations(r.obs)
        values = torch.stack([learner._in_reward_units(learner._critic(o, world.task_id), world.task_id) for o in obs])
        last = learner._final_value(r.last_obs, world.task_id)
        batch, _ = learner._prepare()  # last: it merges the returns into the statistics
    expected = torch.zeros_like(values)
    for n in range(world.num_envs):
        gamma, running = float(OF_TASKS[world.task_id[n]]), 0.0
        for t in reversed(range(8)):
            after = values[t + 1, n] if t < 7 else last[n]
            after = r.final_values[t, n] if r.ended[t, n] else after
            delta = r.rewards[t, n] + gamma * after * float(~r.terminated[t, n]) - values[t, n]
            running = (float(delta) + gamma * config.lam * running * float(~r.ended[t, n])) * float(r.valid[t, n])
            expected[t, n] = running
    for task in range(3):
        rows = world.task_id == task
        mine = expected[:, rows][r.valid[:, rows]]
        scaled = (expected[:, rows] - mine.mean()) / (mine.std(correction=0) + 1e-8) * r.valid[:, rows]
        assert_close(batch.advantages.view(8, -1)[:, rows], scaled, rtol=1e-3, atol=1e-3)
    returns = (expected + values).flatten()
    assert_close(
        batch.targets, learner.return_stats.normalise(returns, learner._element(batch.task_id)), rtol=1e-3, atol=1e-3
    )


@pytest.mark.parametrize("kind", REPLAYING)
def test_bootstraps_and_returns_of_a_replay_are_those_by_hand(kind: str):
    make, config = KINDS[kind]
    world = paying(horizon=50)
    learner = make(world, replace(config, per_task_rewards=False, steps_per_iteration=2), seed=0)
    learner.iterate()
    # No episode has ended, so the statistics hold the sum of rewards, discounted by each row's own factor.
    paid = learner.replay._steps["rewards"][:2]
    by_row = OF_TASKS[world.task_id]
    ended = learner.returns.discounted == 0.0  # these episodes began late
    assert ended.sum() <= 2
    assert_close(learner.returns.discounted[~ended], (by_row * paid[0] + paid[1])[~ended])
    places = learner.replay.draw(1, learner.batch_per_task, learner.generator)
    drawn = learner.replay.take(places[0])
    following = torch.arange(float(len(drawn.rewards)))
    expected = drawn.rewards + OF_TASKS[learner.task_of_draw] * following * ~drawn.terminated
    assert_close(learner._bootstrapped(drawn, following), expected)


def test_a_learner_with_one_discount_for_all_refuses_such_a_world():
    world = PointGoals(24, classes=(PointClass(), PointClass("Far")))
    world.gammas = (0.9, None)
    with pytest.raises(BidexError, match=r"promp: uses one discount .* gives PointGoals one of its own"):
        ProMP(world, replace(PROMP["laptop"], hidden=(8,)), seed=0)


def test_explained_variance():
    task_id, valid = torch.tensor([0, 0, 1]), torch.ones(50, 3, dtype=torch.bool)
    returns = torch.randn(50, 3)
    values = returns.clone()
    values[:, 2] = 7.0
    assert_close(explained_variance(values, returns, task_id, 2, valid), torch.tensor([1.0, 0.0]), atol=1e-5, rtol=0)

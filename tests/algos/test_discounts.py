"""A discount for each class, from the suite's file to the learners, against computations by hand."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from bidex_algos.advantages import discounts, explained_variance, gae, successor_values, task_moments
from bidex_algos.meta.promp import PRESETS as PROMP
from bidex_algos.meta.promp import ProMP
from bidex_algos.offpolicy.mtsac import MTSAC, MTSACConfig
from bidex_algos.offpolicy.td3 import TD3, TD3Config
from bidex_algos.onpolicy.mtppo import MTPPO, MTPPOConfig
from bidex_algos.onpolicy.mttrpo import MTTRPO, MTTRPOConfig
from bidex_meta.errors import BidexError
from tests.algos.families import PointClass, PointGoals
from tests.algos.ranks import same
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
def test_advantages_and_targets_are_those_by_hand(kind: str):
    make, config = KINDS[kind]
    world = paying(unstable=((3, 2), (5, 11)))
    learner = make(world, replace(config, per_task_advantages=True), seed=0)
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
    assert_close(batch.targets, learner._in_critic_units(returns, batch.task_id), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("kind", REPLAYING)
def test_bootstraps_and_returns_of_a_replay_are_those_by_hand(kind: str):
    make, config = KINDS[kind]
    world = paying(horizon=50)
    learner = make(world, replace(config, per_task_rewards=False, steps_per_iteration=2), seed=0)
    learner.iterate()
    # Nothing has ended: the sum of what was paid, discounted by each row's own.
    paid = learner.replay._steps["rewards"][:2]
    by_row = OF_TASKS[world.task_id]
    ended = learner.returns.discounted == 0.0  # of episodes that began late
    assert ended.sum() <= 2
    assert_close(learner.returns.discounted[~ended], (by_row * paid[0] + paid[1])[~ended])
    places = learner.replay.draw(1, learner.batch_per_task, learner.generator)
    drawn = learner.replay.take(places[0])
    following = torch.arange(float(len(drawn.rewards)))
    expected = drawn.rewards + OF_TASKS[learner.task_of_draw] * following * ~drawn.terminated
    assert_close(learner._bootstrapped(drawn, following), expected)


@pytest.mark.parametrize("kind", KINDS)
def test_the_learners_own_number_given_by_each_class_teaches_the_same(kind: str):
    make, config = KINDS[kind]
    ends = []
    for gammas in ((None, None), (0.5, 0.5)):
        learner = make(paying(gammas), replace(config, gamma=0.5), seed=0)
        learner.iterate()  # of 0.5 and lam no rounding differs
        ends.append(learner.state_dict())
    if kind in REPLAYING:
        assert same(*ends)
    weights = [torch.cat([w.flatten() for w in end["policy"]["weights"].values()]) for end in ends]
    assert_close(*weights, rtol=1e-4, atol=1e-5)


def test_a_learner_with_one_discount_for_all_refuses_such_a_world():
    world = PointGoals(24, classes=(PointClass(), PointClass("Far")))
    world.gammas = (0.9, None)
    with pytest.raises(BidexError, match=r"promp: has one discount .* gives PointGoals one of its own"):
        ProMP(world, replace(PROMP["laptop"], hidden=(8,)), seed=0)


def draws(seed: int, steps: int, rows: int):
    g = torch.Generator().manual_seed(seed)

    def normal() -> torch.Tensor:
        return torch.randn(steps, rows, generator=g, dtype=torch.float64)

    def flags(p: float) -> torch.Tensor:
        return torch.rand(steps, rows, generator=g) < p

    return normal, flags


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 9), st.integers(1, 5), st.floats(0, 1), st.floats(0, 1))
def test_gae_is_the_sum_of_its_definition(seed: int, steps: int, rows: int, gamma: float, lam: float):
    normal, flags = draws(seed, steps, rows)
    rewards, values, final, last = normal(), normal(), normal(), normal()[0]
    terminated, truncated, valid = flags(0.2), flags(0.2), ~flags(0.15)
    ended = terminated | truncated | ~valid
    following = successor_values(values, last, ended, final)
    got = gae(rewards, values, following, terminated, ended, gamma, lam, valid)
    for n in range(rows):
        for t in range(steps):
            total, discount = 0.0, 1.0
            for k in range(t, steps):
                if not valid[k, n]:
                    break
                after = final[k, n] if ended[k, n] else (values[k + 1, n] if k + 1 < steps else last[n])
                after = 0.0 if terminated[k, n] else after
                total += discount * (rewards[k, n] + gamma * after - values[k, n])
                discount *= gamma * lam
                if ended[k, n]:
                    break
            assert_close(got[t, n], torch.as_tensor(total, dtype=torch.float64), rtol=1e-9, atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 4))
def test_task_moments_are_those_of_the_valid_entries(seed: int, num_tasks: int):
    normal, flags = draws(seed, 6, 8)
    x, valid = normal(), flags(0.8)
    task_id = torch.arange(8) % num_tasks
    mean, var, count = task_moments(x.masked_fill(~valid, float("nan")), task_id, num_tasks, valid)
    for k in range(num_tasks):
        own = x[valid & (task_id == k)]
        assert count[k] == len(own)
        if len(own):
            assert_close(mean[k], own.mean())
            assert_close(var[k], own.var(correction=0))


def test_explained_variance():
    task_id, valid = torch.tensor([0, 0, 1]), torch.ones(50, 3, dtype=torch.bool)
    returns = torch.randn(50, 3)
    values = returns.clone()
    values[:, 2] = 7.0
    assert_close(explained_variance(values, returns, task_id, 2, valid), torch.tensor([1.0, 0.0]), atol=1e-5, rtol=0)

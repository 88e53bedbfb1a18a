from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from bidex_algos.meta.memory_agent import MemoryAgent
from bidex_algos.meta.rl2 import RL2, RL2Config
from bidex_algos.nets.normalise import RunningStats
from bidex_meta.agents import MetaLearningAgent, Timestep
from bidex_meta.errors import BidexError
from tests.algos.families import EndlessGoals, PointClass, PointGoals, circle, everyone, played, shot
from tests.algos.ranks import resumed, same

SMALL = RL2Config(
    hidden=(32,), activation="tanh", memory=32, init_std=0.6, episodes_per_trial=2, gamma=0.9, chunk=20,
    num_minibatches=2, learning_rate=2e-3, learning_rate_range=(3e-4, 3e-3), critic_learning_rate=3e-3,
)  # fmt: skip
TINY = replace(SMALL, hidden=(8,), memory=8, chunk=4, episodes_per_trial=3)
TEN = (PointClass(steps=10, count=16),)
UNEVEN = (PointClass("Short", steps=3, count=3), PointClass("Long", steps=7, scale=100.0, count=2))


def evaluated(agent: MetaLearningAgent, world: PointGoals) -> float:
    agent.reset(everyone(world))
    return played(agent.eval_action, world)


def state_of(agent: MemoryAgent) -> Tensor:
    assert agent._learned is not None
    return agent._learned.state.clone()


def test_one_shot_closes_most_of_the_gap_to_a_policy_that_knows_the_goal():
    learner = RL2(PointGoals(160, classes=TEN), SMALL, seed=0)
    metrics = [learner.iterate() for _ in range(50)][-1]
    assert metrics["Train/return_last_episode"] > metrics["Train/return_first_episode"] + 1.5

    # These goals lie between the goals of the training.
    test, shown = PointGoals(80, classes=TEN), PointGoals(80, goal_visible=True, classes=TEN)
    test.set_tasks({"PointGoals": circle(16, first=0.2)})
    agent = RL2.load_policy(learner.policy_state_dict())
    best, before = played(shown.best, shown), evaluated(agent, test)
    assert before == pytest.approx(-10.0, abs=1.0)
    shot(agent, test)
    after = evaluated(agent, test)
    assert (after - before) / (best - before) > 0.6
    # The second evaluation learns nothing from the first, and without adaptation all is as before.
    assert evaluated(agent, test) == pytest.approx(after, abs=0.3)
    agent.init()
    assert evaluated(agent, test) == pytest.approx(before, abs=0.3)


def test_each_trial_has_new_tasks_where_they_are_without_number():
    world = EndlessGoals(7, classes=UNEVEN)
    learner = RL2(world, TINY, seed=0)
    for trial in range(3):
        learner.iterate()
        for pool, radius in zip(world.pools, (1.0, 2.0), strict=True):
            np.testing.assert_array_equal(pool, circle(4, first=trial, radius=radius))
        assert world.task_index.tolist() == [0, 1, 2, 3, 0, 1, 2]
    resumed(lambda seed: RL2(EndlessGoals(7, classes=UNEVEN), TINY, seed))


def test_rows_of_different_length_are_recorded_without_gaps():
    learner = RL2(PointGoals(6, classes=UNEVEN), replace(TINY, max_adapt_steps=5), seed=0)
    metrics = learner.iterate()
    t = learner.trials
    assert t.lengths.tolist() == [9, 9, 9, 15, 15, 15]
    assert learner.env_steps == int(t.lengths.sum()) == 72
    ends = [t.ended[:16, row].nonzero().flatten().tolist() for row in (0, 3)]
    assert [e for e in ends[0] if e < 9] == [2, 5, 8] and [e for e in ends[1] if e < 15] == [4, 9, 14]
    # Cut episodes count too, though the world does not know of them.
    assert metrics["Train/mean_episode_length"] == pytest.approx(4.0)
    batch, _ = learner._prepare()
    assert batch.weights.sum(0).tolist() == t.lengths.tolist()
    assert not batch.advantages[9:, :3].any()
    # Positions move by at most 0.2 within an episode, and the next episode begins near the origin.
    jumps = (t.obs[1:15, 3, :2] - t.obs[:14, 3, :2]).abs().amax(1)
    assert (jumps[[0, 1, 2, 3, 5, 6]] <= 0.2001).all() and (t.obs[[0, 5, 10], 3, :2].abs() <= 0.1).all()


@pytest.mark.parametrize("end_at_goal", [False, True])
def test_advantages_are_those_of_the_definition(end_at_goal: bool):
    world = PointGoals(20, classes=(PointClass(steps=6, count=4),), end_at_goal=end_at_goal)
    world.set_tasks({"PointGoals": circle(4, radius=0.25)})
    config = replace(TINY, init_std=1.0, num_minibatches=1)
    learner = RL2(world, config, seed=0)
    learner._update = lambda batch: {}  # type: ignore[method-assign]
    learner.iterate()
    t, g, lam = learner.trials, config.gamma, config.lam
    learner.return_stats = RunningStats((1,))  # so that the critic's units are those of the reward
    learner.return_stats.count.fill_(1e-9)  # as if it knew them, but for next to nothing
    batch, _ = learner._prepare()
    spread = learner.return_stats.std().float()
    returns = batch.targets * spread + learner.return_stats.mean.float()
    for row in range(20):
        n = int(t.lengths[row])
        x = learner.policy.see(t.obs[: n + 1], *(p[: n + 1] for p in t.previous(len(t.obs) - 1)))[:, row]
        value = learner.critic(x[:, None], torch.zeros(1, 8))[0].flatten().detach()
        true_end = t.terminated[:n, row]
        expected, running = torch.zeros(n), 0.0
        for k in range(n - 1, -1, -1):
            # After a true end, the environment stands still without reward until the time limit.
            discount = g ** (1 + int(t.left[k, row])) if true_end[k] else g
            follows = 0.0 if k == n - 1 and true_end[k] else value[k + 1]
            delta = t.rewards[k, row] + discount * follows - value[k]
            running = delta + (discount * lam * running if k < n - 1 else 0.0)
            expected[k] = running
        assert_close(returns[:n, row], expected + value[:n], rtol=1e-4, atol=1e-4)
    assert bool(t.terminated[t.filled()].any()) == end_at_goal


def test_rewards_are_shown_but_for_blind_episodes():
    learner = RL2(PointGoals(400, classes=TEN), replace(SMALL, blind_share=0.3), seed=0)
    learner.iterate()
    shown = learner.trials.shown[:20].view(2, 10, 400)
    assert (shown == shown[:, :1]).all()
    assert 0.6 < float(shown.float().mean()) < 0.8
    obs = torch.zeros(2, 4)
    flags = torch.tensor([True, False])
    x = learner.policy.see(obs, torch.full((2, 2), 3.0), torch.tensor([-1.0, -1.0]), flags, flags)
    assert x.shape == (2, 4 + 2 + 3)
    assert x[:, 4:6].eq(1.0).all()  # what the world did, not what was asked for
    assert x[1, 6:].tolist() == [0.0, 0.0, 0.0] and x[0, 7:].tolist() == [1.0, 1.0] and x[0, 6] != 0.0


def test_chunks_begin_with_the_memory_that_the_trial_had_there(monkeypatch: pytest.MonkeyPatch):
    learner = RL2(PointGoals(16, classes=TEN), replace(TINY, num_minibatches=1), seed=0)
    learner.iterate()  # from now on the policy differs from its beginning
    found: list[Tensor] = []
    gradients = learner._gradients
    monkeypatch.setattr(learner, "_gradients", lambda *given: found.append(gradients(*given)) or found[-1])
    learner.iterate()
    assert abs(float(found[0][2])) < 1e-8, "before the first step, policy and sampling policy are equal"


def test_classes_with_more_tasks_than_rows_take_them_by_turns():
    world = PointGoals(6, classes=(PointClass("Few", steps=2, count=2), PointClass("Many", steps=2, count=5)))
    learner, goals = RL2(world, TINY, seed=0), []
    for _ in range(5):
        learner.iterate()
        goals.append(world.goal.clone())
    few, many = (torch.stack(goals)[:, rows].reshape(-1, 2) for rows in world.slot_env_ids)
    assert torch.unique(many, dim=0, return_counts=True)[1].tolist() == [3] * 5
    assert torch.equal(few[:3], few[3:6])


def test_an_evaluation_leaves_the_training_alone():
    states = []
    for evaluate in (False, True):
        learner = RL2(PointGoals(6, classes=UNEVEN), TINY, seed=0)
        learner.iterate()
        if evaluate:
            test = PointGoals(3)
            shot(learner.agent, test)
            evaluated(learner.agent, test)
        learner.iterate()
        states.append(learner.state_dict())
    assert same(states[0], states[1])


def test_bad_input_is_named():
    with pytest.raises(BidexError, match="SAME_STEP"):
        RL2(PointGoals(4, autoreset_mode="SAME_STEP"), SMALL, seed=0)
    with pytest.raises(BidexError, match="num_envs"):
        RL2(PointGoals(1), SMALL, seed=0)


def agent_on(world: PointGoals) -> MemoryAgent:
    learner = RL2(PointGoals(8, classes=TEN), SMALL, seed=0)
    learner.iterate()
    agent = RL2.load_policy(learner.policy_state_dict())
    agent.assign(torch.zeros(world.num_envs, dtype=torch.int64))
    agent.init()
    return agent


def test_evaluation_episodes_start_from_what_adaptation_left():
    world = PointGoals(4, classes=TEN)
    agent = agent_on(world)
    shot(agent, world)
    left = state_of(agent)
    obs = torch.zeros(4, 4)
    first = []
    for _ in range(3):
        agent.reset(everyone(world))
        first.append(agent.eval_action(obs))
        assert not torch.equal(agent.eval_action(obs), first[-1])  # the memory goes on within the episode
    assert torch.equal(first[0], first[1]) and torch.equal(first[0], first[2])
    assert torch.equal(state_of(agent), left)
    # A second shot continues from the first shot, not from an evaluation.
    shot(agent, world)
    assert not torch.equal(state_of(agent), left)
    agent.init()
    agent.reset(everyone(world))
    assert not state_of(agent).any()


def test_the_reward_of_an_evaluation_step_is_seen_where_it_is_shown():
    world = PointGoals(4, classes=TEN)
    agent = agent_on(world)
    shot(agent, world)
    left = state_of(agent)
    obs, no = torch.zeros(4, 4), torch.zeros(4, dtype=torch.bool)
    valid = torch.tensor([True, True, True, False])

    def second(reward: float | None) -> Tensor:
        """The second action of an episode, after a first step with this reward; None: it is hidden."""
        agent.reset(everyone(world))
        action = agent.eval_action(obs)
        if reward is not None:
            agent.observe(Timestep(obs, action, torch.full((4,), reward), no, no, {}, obs, valid))
        return agent.eval_action(obs)

    hidden, low, high = second(None), second(-1.0), second(1.0)
    assert (low[:3] != high[:3]).any(dim=1).all() and (low[:3] != hidden[:3]).any(dim=1).all()
    assert torch.equal(low[3], hidden[3]), "a step whose physics broke shows nothing"
    assert torch.equal(state_of(agent), left)


def test_the_agent_waits_with_rows_whose_episode_is_over():
    world = PointGoals(6, classes=UNEVEN)
    agent = agent_on(world)
    obs, _ = world.reset()
    agent.reset(everyone(world))
    over = ~everyone(world)
    for t in range(7):
        action, aux = agent.adapt_action(obs)
        obs, reward, terminated, truncated, _ = world.step(action)
        before = state_of(agent)
        agent.step(Timestep(obs, action, reward, terminated, truncated, aux, obs, ~over))
        over = terminated | truncated
        same = (state_of(agent) == before).all(1)
        assert same.tolist() == [t >= 3] * 3 + [False] * 3
    assert agent._learned is not None and agent._learned.done.all()


def test_the_agent_plays_the_trial_that_the_training_played():
    learner = RL2(PointGoals(6, classes=UNEVEN), replace(TINY, blind_share=0.0), seed=0)
    learner._update = lambda batch: {}  # type: ignore[method-assign]
    learner.iterate()
    t, agent = learner.trials, MemoryAgent(learner.policy)
    # The statistics have changed, so we compute the memory with the current ones.
    previous = t.previous(len(t.obs) - 1)
    for row in (0, 5):
        agent.init()
        n = int(t.lengths[row])
        x = learner.policy.see(t.obs[:n], *(p[:n] for p in previous))[:, row]
        _, expected = learner.policy.actor(x[:, None], torch.zeros(1, 8))
        agent.reset(torch.ones(1, dtype=torch.bool))
        for k in range(n):
            _, aux = agent.adapt_action(t.obs[k, row][None])
            told = (t.obs[k, row], t.actions[k, row], t.rewards[k, row], torch.tensor(False), t.ended[k, row])
            agent.step(Timestep(*(x[None] for x in told), aux, None, torch.ones(1, dtype=torch.bool)))
            if t.ended[k, row]:
                agent.reset(torch.ones(1, dtype=torch.bool))
        assert_close(state_of(agent), expected.detach())

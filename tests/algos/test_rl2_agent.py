"""RL²'s agent: what it remembers, and when it forgets."""

from dataclasses import replace

import torch
from torch.testing import assert_close

from bidex_algos.meta.rl2 import RL2, RL2Agent
from bidex_meta.agents import Timestep
from tests.algos.families import PointGoals
from tests.algos.test_rl2 import SMALL, TEN, TINY, UNEVEN, adapted, everyone, state_of


def agent_on(world: PointGoals) -> RL2Agent:
    learner = RL2(PointGoals(8, classes=TEN), SMALL, seed=0)
    learner.iterate()
    agent = RL2.load_policy(learner.policy_state_dict())
    agent.assign(torch.zeros(world.num_envs, dtype=torch.int64))
    agent.init()
    return agent


def test_evaluation_episodes_start_from_what_adaptation_left():
    world = PointGoals(4, classes=TEN)
    agent = agent_on(world)
    adapted(agent, world)
    left = state_of(agent)
    obs = torch.zeros(4, 4)
    first = []
    for _ in range(3):
        agent.reset(everyone(world))
        first.append(agent.eval_action(obs))
        assert not torch.equal(agent.eval_action(obs), first[-1])  # the memory goes on within the episode
    assert torch.equal(first[0], first[1]) and torch.equal(first[0], first[2])
    assert torch.equal(state_of(agent), left)
    # A second shot goes on from the first, not from an evaluation.
    adapted(agent, world)
    assert not torch.equal(state_of(agent), left)
    agent.init()
    agent.reset(everyone(world))
    assert not state_of(agent).any()


def test_reset_of_some_rows_leaves_the_others_in_their_episode():
    agent = agent_on(PointGoals(4, classes=TEN))
    obs, mask = torch.ones(4, 4), torch.tensor([True, False, True, False])
    agent.reset(~mask | mask)
    first = agent.eval_action(obs)
    agent.reset(mask)
    second = agent.eval_action(obs)
    assert torch.equal(first[mask], second[mask]) and not (first[~mask] == second[~mask]).all(1).any()


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


def test_rows_that_play_no_episode_learn_nothing():
    world = PointGoals(4, classes=TEN)
    agent, some = agent_on(world), torch.tensor([True, False, True, False])
    obs, _ = world.reset()
    agent.reset(some)
    action, aux = agent.adapt_action(obs)
    obs, reward, terminated, truncated, _ = world.step(action)
    agent.step(Timestep(obs, action, reward, terminated, truncated, aux, obs, some))
    assert torch.equal(state_of(agent).any(1), some)
    agent.reset(everyone(world))  # an evaluation
    before = state_of(agent)
    agent.reset(some)
    action, aux = agent.adapt_action(obs)
    agent.step(Timestep(obs, action, reward, terminated, truncated, aux, obs, some))
    assert torch.equal((state_of(agent) != before).any(1), some)


def test_the_agent_plays_the_trial_that_the_training_played():
    learner = RL2(PointGoals(6, classes=UNEVEN), replace(TINY, blind_share=0.0), seed=0)
    learner._update = lambda batch: {}  # type: ignore[method-assign]
    learner.iterate()
    t, agent = learner.trials, RL2Agent(learner.policy)
    # Statistics have moved since: what the memory would be by the present ones.
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

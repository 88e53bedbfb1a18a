"""VariBAD: what a trial tells a belief, what of it is decoded, and who trains what."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from bidex_algos.meta.trials import Batch
from bidex_algos.meta.varibad import VariBAD, VariBADConfig
from bidex_meta.agents import MetaLearningAgent
from tests.algos.families import PointClass, PointGoals, circle, everyone, played, shot

SMALL = VariBADConfig(
    hidden=(32,), activation="tanh", memory=32, latent=4, init_std=0.6, episodes_per_trial=2, gamma=0.9,
    num_minibatches=2, learning_rate=2e-3, learning_rate_range=(3e-4, 3e-3), critic_learning_rate=3e-3,
    belief_learning_rate=3e-3, max_adapt_steps=300, blind_share=0.3,
)  # fmt: skip
TEN = (PointClass(steps=10, count=16),)
UNEVEN = (PointClass("Short", steps=3, count=3), PointClass("Long", steps=7, scale=100.0, count=2))


def evaluated(agent: MetaLearningAgent, world: PointGoals) -> float:
    agent.reset(everyone(world))
    return played(agent.eval_action, world)


def recorded(world: PointGoals, config: VariBADConfig = SMALL) -> tuple[VariBAD, Batch, Tensor]:
    """A learner that has measured one trial; the next one, and all its rows."""
    learner = VariBAD(world, config, seed=0)
    updates: list[Batch] = []
    learner._update = lambda batch: updates.append(batch) or {}  # type: ignore[method-assign, func-returns-value]
    learner.iterate()
    learner.iterate()
    return learner, updates[0], torch.arange(world.num_envs)


def test_one_shot_closes_half_of_the_gap_to_a_policy_that_knows_the_goal() -> None:
    learner = VariBAD(PointGoals(160, classes=TEN), SMALL, seed=0)
    metrics = [learner.iterate() for _ in range(40)]
    assert metrics[-1]["Train/return_last_episode"] > metrics[-1]["Train/return_first_episode"] + 1.0

    # These goals lie between the goals of the training.
    test, shown = PointGoals(80, classes=TEN), PointGoals(80, goal_visible=True, classes=TEN)
    test.set_tasks({"PointGoals": circle(16, first=0.2)})
    agent = VariBAD.load_policy(learner.policy_state_dict())
    best, before = played(shown.best, shown), evaluated(agent, test)
    assert before == pytest.approx(-10.0, abs=1.0)
    shot(agent, test)
    assert (evaluated(agent, test) - before) / (best - before) > 0.45  # 0.57


def test_beliefs_learn_to_tell_goals_apart_from_rewards_alone() -> None:
    world = PointGoals(32, classes=(PointClass(steps=10, count=2),))
    world.set_tasks({"PointGoals": np.array([[1.0, 0.0], [0.0, 0.3]])})
    learner, batch, rows = recorded(world)
    losses = [float(learner._descend(batch, rows)[0]) for _ in range(60)]
    assert losses[0] > 0.8 and losses[-1] < 0.35
    with torch.no_grad():
        x = learner.policy.see(batch.obs, *batch.previous)
        mean, log_std, _ = learner.net.believe(x, batch.actor_states[0])
        ends = mean[-1].view(16, 2, -1)  # goals alternate
        apart, spread = (ends[:, 0] - ends[:, 1]).mean(0).norm(), ends.std(0).norm(dim=1).mean()
        assert apart > 2.0 * spread and log_std[-1].mean() < log_std[0].mean() - 0.3
        # Beliefs of other trials with the same goal predict the rewards; beliefs of trials with the other goal do not.
        off = [
            learner.net.decode_reward(x, mean[-1:].roll(by, 1))[0] - learner.policy.earned(batch.previous[1])
            for by in (2, 1)
        ]
        same, other = (each[1:].square().mean() for each in off)
    assert same < 0.3 and other > 1.0


def test_ppo_and_the_bound_train_weights_of_their_own() -> None:
    learner, batch, rows = recorded(PointGoals(8))
    net = learner.net
    learner._gradients(batch, rows, batch.weights.sum(), learner.policy.log_std.detach())
    moved = {name for name, weight in net.named_parameters() if weight.grad is not None}
    assert moved == {name for name, _ in net.named_parameters() if name.startswith("actor.")}
    before = [weight.clone() for weight in net.actor.parameters()]
    learner.policy.zero_grad()
    learner._descend(batch, rows)
    assert all(weight.grad is not None and weight.grad.any() for weight in learner.model)
    assert all(map(torch.equal, before, net.actor.parameters()))


@pytest.mark.parametrize("unstable", [(), ((2, 5), (9, 1))])
def test_what_is_decoded_is_seen_and_each_belief_is_compared_to_the_last(
    unstable: tuple[tuple[int, int], ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    learner, batch, rows = recorded(PointGoals(6, classes=UNEVEN, unstable=unstable), replace(SMALL, latent=3))
    net, trials = learner.net, learner.trials
    slots, lengths = len(batch.weights), trials.lengths
    seen = torch.zeros(slots, 6, dtype=torch.bool)  # whose reward was earned by what the slot shows
    for row in range(6):
        for slot in range(1, int(lengths[row]) + 1):
            ended = trials.ended[slot - 1, row] and slot < lengths[row]
            seen[slot, row] = trials.valid[slot - 1, row] and not ended
    assert seen.any(0).all() and not seen.all(1)[1:].all()
    monkeypatch.setattr("bidex_algos.meta.varibad._TIMES", slots)
    monkeypatch.setattr(net, "decode_reward", lambda x, latent: torch.zeros(len(latent), *x.shape[:2]))
    monkeypatch.setattr(
        net, "believe", lambda x, state: (torch.ones(*x.shape[:2], 3), torch.zeros(*x.shape[:2], 3), state)
    )
    for marked, expected in ((~seen, 0.0), (seen, 1.0)):
        monkeypatch.setattr(learner.policy, "earned", lambda reward, marked=marked: marked.float())
        error, divergence = learner._elbo_terms(batch, rows)
        assert float(error) == pytest.approx(expected)
    # The first of these unit Gaussians at 1 is compared with one at 0.
    assert float(divergence) == pytest.approx(3 * 0.5 * 6 / float(batch.weights.sum()))

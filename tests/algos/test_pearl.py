"""PEARL: what one episode tells, which transitions the posterior is made of, what each environment learns from."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch.distributions import Independent, Normal, kl_divergence
from torch.testing import assert_close

from bidex_algos.meta.latent_agent import LatentAgent
from bidex_algos.meta.pearl import PEARL, PEARLConfig
from bidex_meta.errors import BidexError
from tests.algos.families import EndlessGoals, PointClass, PointGoals, Slopes, everyone, played, shot

SMALL = PEARLConfig(
    hidden=(32, 32), encoder=(32, 32), latent=2, context=20, batch_size=256, replay_steps=300, cut_share=0.2,
    warmup_steps=10, steps_per_iteration=20, updates_per_step=2, gamma=0.0, learning_rate=3e-3, init_alpha=0.1,
    critic_learning_rate=3e-3, target_entropy_per_action=0.0, critic_layer_norm=False, episodes_per_trial=2,
    kl_weight=0.1, autocast="off",
)  # fmt: skip
TINY = replace(SMALL, hidden=(8,), encoder=(8,), batch_size=16, context=64, warmup_steps=1000, episodes_per_trial=3)
UNEVEN = (PointClass("Short", steps=3, count=3), PointClass("Long", steps=7, count=2))


def share(agent: LatentAgent, world: Slopes) -> float:
    """Of the best return, that of an evaluation."""
    agent.reset(everyone(world))
    return played(agent.eval_action, world) / world.best()  # type: ignore[arg-type]


def test_one_episode_tells_what_is_paid() -> None:
    learner = PEARL(Slopes(mode="SAME_STEP", steps=10), SMALL, seed=0)
    for _ in range(10):
        learner.iterate()
    # The slopes include some between those of the training.
    test, agent = Slopes(33, tasks=33, steps=10), PEARL.load_policy(learner.policy_state_dict())
    assert abs(share(agent, test)) < 0.2
    shot(agent, test)  # type: ignore[arg-type]
    assert share(agent, test) > 0.8
    # The task's own data help, because data of the opposite task mislead.
    agent.init()
    test.goal = -test.goal
    shot(agent, test)  # type: ignore[arg-type]
    test.goal = -test.goal
    assert share(agent, test) < -0.8


def learner_on(classes: Any = UNEVEN, rows: int = 7, config: PEARLConfig = TINY) -> PEARL:
    return PEARL(PointGoals(rows, classes=classes, autoreset_mode="SAME_STEP"), config, seed=0)


def test_tasks_without_number_are_refused() -> None:
    with pytest.raises(
        BidexError, match=r"pearl: expected a fixed number of train tasks, .* Use --tasks-per-class 100"
    ):
        PEARL(EndlessGoals(8, autoreset_mode="SAME_STEP"), TINY, seed=0)


def test_the_posterior_is_made_of_the_episodes_of_a_trial() -> None:
    learner = learner_on()
    learner.policy.evidence = lambda obs, actions, reward, following: reward[:, None]  # type: ignore[method-assign]
    shown: list[Any] = []
    learner._sample = lambda mean, std: torch.zeros_like(mean)  # type: ignore[method-assign]
    sums = learner._evidence_sum
    learner._evidence_sum = lambda rows, *given: shown.append((rows, *given)) or torch.zeros(len(rows), 4)  # type: ignore[func-returns-value, method-assign]
    learner.iterate()
    # After 20 steps, rows 0 to 3 have ended six episodes of three steps, and rows 4 to 6 two of seven steps.
    of_short, of_long = ([episodes[rows == row].item() for rows, _, episodes in shown if row in rows] for row in (0, 4))
    assert of_short == [1, 2, 0, 1, 2, 0] and of_long == [1, 2]
    assert learner.bounds[:, 0, 0].tolist() == [9, 18]
    # The batch takes the first two episodes of the last trial but one: steps 9 to 14 of those rows, 64 draws with
    # repetition.
    rewards = learner.replay._steps["rewards"][9:15, :4]
    rows = torch.arange(4)
    found = sums(rows, torch.zeros_like(rows), torch.full_like(rows, 2))
    assert_close(found[:, 0], rewards.sum(0), rtol=0.1, atol=0.0)
    assert not sums(rows, torch.ones_like(rows), torch.zeros_like(rows)).any()


@pytest.mark.parametrize("held", [8, 4])
def test_transitions_that_the_replay_no_longer_holds_tell_nothing(held: int) -> None:
    learner = learner_on(config=replace(TINY, replay_steps=held, context=2000))
    learner.iterate()
    learner.policy.evidence = lambda obs, actions, reward, following: reward[:, None]  # type: ignore[method-assign]
    assert learner.replay.filled == held and learner.bounds[0, 0].tolist()[:3] == [9, 12, 15]
    rows = torch.arange(4)
    found = learner._evidence_sum(rows, torch.zeros_like(rows), torch.full_like(rows, 2))[:, 0]
    # Of the trial's steps 9 to 14, a replay of eight steps holds the last three, one of four steps none.
    rewards = learner.replay._steps["rewards"]
    kept = [rewards[step % len(rewards), :4] for step in range(9, 15) if step >= 20 - held]
    expected = 6 * torch.stack(kept).mean(0) if kept else torch.zeros(4)
    assert_close(found, expected, rtol=0.05, atol=0.0)


def test_the_agent_adds_up_what_an_update_estimates() -> None:
    learner = learner_on(rows=5)
    learner.iterate()
    policy = learner.policy
    agent, world = LatentAgent(policy), PointGoals(5, classes=UNEVEN)
    shot(agent, world)
    mean, std = policy.posterior(agent._sums)
    assert (std < 1.0).all() and mean.any()
    # Waiting environments add nothing after three and after seven steps.
    precise = policy.evidence(torch.zeros(1, 4), torch.zeros(1, 2), torch.zeros(1), torch.zeros(1, 4))[0, :2]
    count = agent._sums[:, :2] / precise
    assert count[:3].max() < count[3:].min()
    # Evaluation teaches nothing, the next shot continues, and at the start the posterior equals the prior.
    left = agent._sums.clone()
    agent.reset(everyone(world))
    played(agent.eval_action, world)
    assert torch.equal(agent._sums, left)
    agent.init()
    agent.reset(everyone(world))
    mean, std = policy.posterior(agent._sums)
    assert not mean.any() and (std == 1.0).all()
    assert not torch.equal(agent.adapt_action(torch.zeros(5, 4))[0][0], agent.adapt_action(torch.zeros(5, 4))[0][1])


def test_an_episode_keeps_its_latent_variable() -> None:
    agent, obs = LatentAgent(learner_on(rows=5).policy), torch.zeros(5, 4)
    agent.reset(torch.ones(5, dtype=torch.bool))
    agent.adapt_action(obs)
    first = agent._latent
    agent.adapt_action(obs)
    assert torch.equal(agent._latent, first) and len(first.unique(dim=0)) == 5
    agent.reset(torch.arange(5) == 2)
    agent.adapt_action(obs)
    assert (agent._latent != first).any(1).tolist() == [False, False, True, False, False]


def test_an_update_learns_from_all_environments_of_the_chosen_tasks() -> None:
    learner = learner_on(rows=14, config=replace(TINY, warmup_steps=1, tasks_per_update=4, steps_per_iteration=5))
    world: Any = learner.world
    draws: list[Any] = []
    learner._infer = lambda rows, draw, *_: draws.append((rows, draw)) or {"Loss/critic": torch.zeros(())}  # type: ignore[func-returns-value, method-assign]
    learner.iterate()
    # Two classes have two tasks each; distances to their goals tell the tasks apart.
    for rows, draw in draws:
        assert world.task_id[rows].tolist() == [0, 0, 1, 1]
        goals = world.goal[rows][learner.which]
        assert_close(-draw.rewards, (draw.next_obs[:, :2] - goals).norm(dim=1))


def test_tasks_without_an_environment_are_refused() -> None:
    with pytest.raises(BidexError, match=r"Short has 3 tasks and 2 environments.* Raise num_envs to 6"):
        learner_on(rows=4)


def test_critics_learn_from_the_next_observation_and_the_encoder_from_its_divergence(monkeypatch: pytest.MonkeyPatch):
    config = replace(TINY, warmup_steps=10, steps_per_iteration=40, gamma=0.7)
    learner = PEARL(PointGoals(8, autoreset_mode="SAME_STEP"), config, seed=0)
    found: dict[str, Any] = {}

    def recorded(name: str) -> None:
        method = getattr(learner, name)

        def record(*given: Any) -> Any:
            result = method(*given)
            found[name] = given, result
            return result

        monkeypatch.setattr(learner, name, record)

    for name in ("_sample", "_target", "_fit_critics"):
        recorded(name)
    learner.iterate()
    (mean, std), latent = found["_sample"]
    (draw, following), _ = found["_target"]
    beside = found["_fit_critics"][0][5]
    of_draw = latent[learner.which].detach()
    assert not torch.equal(draw.obs, draw.next_obs)
    assert_close(following, learner.policy.seen(draw.next_obs, of_draw))
    prior = Independent(Normal(torch.zeros_like(mean), torch.ones_like(mean)), 1)
    expected = kl_divergence(Independent(Normal(mean, std), 1), prior).mean()
    assert_close(beside, config.kl_weight * expected)

"""Teachers beside PPO: what it forgets without them, when they count and when not, what they leave alone, resuming."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from bidex_algos.onpolicy.lessons import needs
from bidex_algos.onpolicy.mtppo import MTPPO, MTPPOConfig
from bidex_meta.training.learner import Sources
from bidex_meta.witness.teachers import Teachers, Tutor
from tests.algos.ranks import resumed
from tests.algos.test_dagger import Constant, Following
from tests.algos.toy import ToyWorld, nearness

SMALL = MTPPOConfig(
    hidden=(32, 32), num_minibatches=2, epochs=2, learning_rate=1e-3, init_std=0.2, critic_first=2048, autocast="off",
    teacher_updates=16,
)  # fmt: skip


def needle(action: Tensor) -> Tensor:
    """Solved near 0.5 alone, while what is paid elsewhere leads to -0.5: exploring actions hardly ever solve it."""
    near = (action - 0.5).abs().amax(-1) < 0.08
    return torch.where(near, 1.0, 0.8 * (1.0 - (action + 0.5).square().mean(-1)))


def skilled(world: ToyWorld, config: MTPPOConfig, taught: bool, seed: int = 0, kind: Any = Teachers) -> MTPPO:
    """One that solves the first task from its start, with a teacher of this task alone or without."""
    sources = Sources()
    if taught:
        tutor = Tutor(Constant(0.5, 0.5), torch.arange(world.num_envs // 2), 3)
        sources = Sources(teachers=kind(world, [tutor]))
    learner = MTPPO(world, config, seed, sources)
    with torch.no_grad():
        learner.policy.actor.mean.output_bias.fill_(0.5)
    return learner


def test_ppo_forgets_what_its_reward_leads_away_from_and_keeps_it_with_a_teacher() -> None:
    found = {}
    for taught in (False, True):
        world = ToyWorld([needle, nearness(-0.5)], rows=64)
        learner = skilled(world, SMALL, taught)
        obs, _ = world.reset(seed=1)
        before, weights = learner.eval_action(obs), list[float]()
        for _ in range(2):
            learner.iterate()
        assert torch.equal(learner.eval_action(obs), before)  # the critic alone has learned
        for _ in range(42):
            reported = learner.iterate()
            weights.append(reported.get("Policy/teacher_weight/task0", 0.0))
            assert "Policy/teacher_weight/task1" not in reported
        found[taught] = learner.eval_action(obs)[:64].mean().item(), reported["Train/success/task0"]
        assert reported["Train/success/task1"] > 0.9
    assert found[False][0] < 0.0 and found[False][1] < 0.05
    assert found[True][0] == pytest.approx(0.5, abs=0.06) and found[True][1] > 0.5
    assert weights[0] > 0.5 and weights[-1] < 0.4


def test_a_policy_to_start_from_gets_deviations_within_bounds_and_small_steps() -> None:
    world, config = ToyWorld([needle, nearness(-0.5)], rows=4), replace(SMALL, critic_first=0)
    narrow = replace(config, init_std=0.05, std_range=(0.01, 0.05), learning_rate_range=(1e-6, 1e-3))
    learner = skilled(world, narrow, taught=False)
    learner.start_from(skilled(world, config, taught=False).policy_state_dict())
    assert float(learner.policy.actor.log_std.detach().exp().max()) == pytest.approx(0.05)
    reported = learner.iterate()
    assert reported["Policy/lr"] <= 1.5**3 * 1.01e-6 and reported["Policy/kl"] < 0.03


@pytest.mark.parametrize("rate", [None, 2e-3])
def test_a_critic_that_learns_alone_takes_whole_steps(rate: float | None) -> None:
    """The policy to start from lowers the actor's steps, which the critic may share."""
    world = ToyWorld([needle, nearness(-0.5)], rows=4)
    config = replace(SMALL, critic_learning_rate=rate, critic_first=10**6)
    plain, started = (skilled(world, config, taught=False) for _ in range(2))
    started.start_from(plain.policy_state_dict())
    moved = []
    for learner in (plain, started):
        before = torch.nn.utils.parameters_to_vector(learner.critic.parameters()).detach().clone()
        learner.world.reset(seed=0)
        reported = learner.iterate()
        moved.append(torch.nn.utils.parameters_to_vector(learner.critic.parameters()).detach() - before)
    assert float(moved[1].norm() / moved[0].norm()) == pytest.approx(1.0, abs=0.2)
    assert reported["Policy/lr"] == pytest.approx(config.learning_rate_range[0])


def test_a_weight_falls_with_success_and_rises_where_it_falls() -> None:
    learner = skilled(ToyWorld([needle, nearness(-0.5)], rows=4), SMALL, taught=True)
    found = []
    for solved, ended in ((0, 0), (40, 100), (80, 100), (95, 100), (20, 100), (2, 2)):
        learner.episodes.sums[2:] = torch.tensor([[solved, 0], [ended, 100]])
        found.append(float(needs(learner.episodes)[0]))
    assert found == pytest.approx([1.0, 0.5, 0.0, 0.0, 0.75, 0.875])


@pytest.mark.parametrize("surgery", ["none", "pcgrad"])
def test_without_updates_it_is_mt_ppo_bit_for_bit(surgery: str) -> None:
    config = replace(SMALL, teacher_updates=0, critic_first=0, gradient_surgery=surgery)
    plain, taught = (skilled(ToyWorld([needle, nearness(-0.5)], rows=4), config, taught) for taught in (False, True))
    for learner in (plain, taught):
        for _ in range(3):
            learner.iterate()
    pairs = zip(plain.policy.state_dict().values(), taught.policy.state_dict().values(), strict=True)
    assert all(torch.equal(a, b) for a, b in pairs)


def test_teachers_are_asked_in_each_step_and_begin_with_each_episode() -> None:
    world, teacher = ToyWorld([needle, nearness(-0.5)], rows=4, unstable=((3, 0),)), Constant(0.5, 0.5)
    learner = MTPPO(world, SMALL, 0, Sources(teachers=Teachers(world, [Tutor(teacher, torch.arange(4), 3)])))
    for _ in range(2):
        learner.iterate()
    ended = int(world.episodes.number[:4].sum()) - int(learner.rollout.ended[-1, :4].sum())  # before the last step
    assert teacher.asked == 16 and teacher.begun == 4 + ended


def test_a_resumed_run_goes_on_bit_for_bit_or_with_new_episodes() -> None:
    def make(seed: int, kind: Any = Teachers) -> MTPPO:
        return skilled(ToyWorld([needle, nearness(-0.5)], rows=4), replace(SMALL, critic_first=0), True, seed, kind)

    resumed(make, iterations=2)
    learner, again = make(0, Following), make(1, Following)
    learner.iterate()
    again.world.load_state_dict(learner.world.state_dict())
    again.load_state_dict(learner.state_dict())
    assert torch.equal(again.world.episodes.number, learner.world.episodes.number + 1)
    again.iterate()

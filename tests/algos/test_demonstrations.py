"""Demonstrations beside PPO: the term against its definition, its fading, what it leaves alone, resuming."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch.distributions import Normal

from bidex_algos.onpolicy import demonstrations
from bidex_algos.onpolicy.demonstrations import Demonstrations, imitation
from bidex_algos.onpolicy.mtppo import MTPPO, MTPPOConfig
from bidex_meta.errors import BidexError
from bidex_meta.training.learner import Sources
from tests.algos.ranks import resumed
from tests.algos.toy import ToyWorld, nearness
from tests.offline.stored import as_data, noisy, played

SMALL = MTPPOConfig(hidden=(16,), rollout_steps=4, num_minibatches=2, epochs=2, autocast="off")


@pytest.fixture(autouse=True)
def fast_fading(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demonstrations, "HALF_LIFE", 400.0)


NOTHING = [lambda action: torch.zeros(len(action)), lambda action: torch.zeros(len(action))]


def world(rewards: Any = None) -> ToyWorld:
    return ToyWorld(rewards or [nearness(0.5), nearness(-0.5)], rows=8)


def shown(action: float = 0.4, seed_rows: int = 8, only: int | None = None) -> Any:
    found = played(ToyWorld(NOTHING, rows=seed_rows), noisy(lambda obs: torch.full((len(obs), 2), action), 0.02), 9)
    return as_data([episode for episode in found if only in (None, episode.task)])


def trained(config: MTPPOConfig, data: Any, iterations: int = 3, rewards: Any = None) -> tuple[MTPPO, dict[str, float]]:
    learner = MTPPO(world(rewards), config, 3, Sources(demonstrations=data))
    told = {}
    for _ in range(iterations):
        told = learner.iterate()
    return learner, told


def same(one: MTPPO, other: MTPPO) -> bool:
    pairs = zip(one.policy.state_dict().values(), other.policy.state_dict().values(), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


def test_the_term_is_the_log_density_and_leaves_deviations_alone() -> None:
    torch.manual_seed(0)
    means, log_std, actions = torch.randn(6, 3, requires_grad=True), torch.randn(3), torch.randn(6, 3)
    normal = Normal(means, log_std.exp())
    constant = -Normal(torch.zeros(3), log_std.exp()).log_prob(torch.zeros(3)).sum()
    expected = -normal.log_prob(actions).sum(-1).mean() - constant
    assert float(imitation(actions, means, log_std).detach()) == pytest.approx(float(expected.detach()), rel=1e-5)
    learner, _ = trained(SMALL, shown(), iterations=1)
    learner.policy.actor.zero_grad()
    assert learner.demonstrations is not None
    learner.demonstrations.loss(learner.policy).backward()
    slopes = {name: weight.grad for name, weight in learner.policy.actor.named_parameters()}
    assert slopes.pop("log_std") is None
    assert all(slope is not None for slope in slopes.values())


def test_the_weight_falls_to_half_in_each_half_life() -> None:
    some = Demonstrations(shown(), 256, 0, torch.device("cpu"))
    assert [some.weight(steps) for steps in (0, 400, 1200)] == pytest.approx([0.1, 0.05, 0.0125])
    learner, told = trained(SMALL, shown(), iterations=3)
    before = learner.env_steps - learner.env_steps // 3  # the last update came before these steps were counted
    assert told["Policy/demonstration_weight"] == pytest.approx(0.1 * 0.5 ** (before / 400))
    assert told["Loss/demonstrations"] > 0.0


@pytest.mark.parametrize("surgery", ["none", "pcgrad"])
def test_weight_0_is_mt_ppo_bit_for_bit(surgery: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demonstrations, "WEIGHT", 0.0)
    config = replace(SMALL, gradient_surgery=surgery)
    plain, told = trained(config, None)
    with_data, more = trained(config, shown())
    assert same(plain, with_data)
    assert more["Policy/demonstration_weight"] == 0.0
    assert "Policy/demonstration_weight" not in told


def test_each_task_that_has_some_is_drawn_equally_often() -> None:
    both = shown(seed_rows=2)
    one = torch.nonzero(both.task == 1).flatten()
    few = replace(both, task=torch.where(torch.isin(torch.arange(len(both)), one[1:]), 0, both.task))  # one of task 1
    drawn = Demonstrations(few, 4000, 0, torch.device("cpu")).draw()[1]
    assert float((drawn == both.actions[one[0]]).all(1).float().mean()) == pytest.approx(0.5, abs=0.03)
    alone = Demonstrations(shown(only=1), 256, 0, torch.device("cpu"))
    assert torch.equal(alone.draw()[0][:, 1:], torch.tensor([0.0, 1.0]).expand(256, 2))


def test_where_nothing_is_rewarded_the_policy_does_what_it_was_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demonstrations, "WEIGHT", 1.0)
    monkeypatch.setattr(demonstrations, "HALF_LIFE", 1e9)
    config = replace(SMALL, learning_rate_range=(1e-3, 3e-3))
    obs = torch.tensor([[0.3, 1.0, 0.0], [-0.2, 0.0, 1.0]])
    shown_to, _ = trained(config, shown(0.4), 40, NOTHING)
    assert float((shown_to.eval_action(obs) - 0.4).abs().max()) < 0.1


def test_a_cloned_policy_does_what_it_was_shown_before_it_learns_anything() -> None:
    still = {"learning_rate": 1e-9, "learning_rate_range": (1e-9, 2e-9)}
    config = replace(SMALL, demonstration_cloning=300, **still)
    obs = torch.tensor([[0.3, 1.0, 0.0], [-0.2, 0.0, 1.0]])
    cloned, _ = trained(config, shown(0.4), 1)
    assert float((cloned.eval_action(obs) - 0.4).abs().max()) < 0.05
    deviation = MTPPO(world(), config, seed=3).policy.actor.log_std
    assert float((cloned.policy.actor.log_std - deviation).abs().max()) < 1e-6


def test_the_critic_learns_alone_at_first_and_the_policy_stays_as_cloned() -> None:
    config = replace(SMALL, demonstration_cloning=50, learning_rate=1e-2)
    (cloned, _), (longer, told), (later, _) = (
        trained(replace(config, critic_first=steps), shown(), iterations)
        for steps, iterations in ((1, 1), (129, 3), (129, 4))
    )
    assert same(cloned, longer) and not same(longer, later)
    assert told["Policy/kl"] == pytest.approx(0.0, abs=1e-6) and float(told["Policy/lr"]) == pytest.approx(1e-2)
    critics = [list(learner.critic.parameters()) for learner in (cloned, longer)]
    assert all(not torch.equal(a, b) for a, b in zip(*critics, strict=True))


@pytest.mark.parametrize("cloning", [0, 5])
def test_a_resumed_run_goes_on_bit_for_bit_with_its_own_data_alone(cloning: int) -> None:
    config = replace(SMALL, demonstration_cloning=cloning, critic_first=12 * cloning)

    def make(seed: int, rows: int = 8) -> MTPPO:
        return MTPPO(world(), config, seed, Sources(demonstrations=shown(seed_rows=rows)))

    learner, _ = resumed(make, iterations=2)
    assert "demonstrated" in learner.per_process and "demonstrated" not in MTPPO.per_process
    with pytest.raises(BidexError, match="demonstrations are others"):
        make(9, rows=2).load_state_dict(learner.state_dict())

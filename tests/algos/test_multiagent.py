"""Learners of several agents: as one agent the single-agent's own; the product of ratios; a game that needs turns."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.distributions import Normal

from bidex_algos.multiagent.happo import HAPPO, HAPPOConfig
from bidex_algos.multiagent.hatrpo import HATRPO, HATRPOConfig
from bidex_algos.multiagent.ippo import IPPO, IPPOConfig
from bidex_algos.multiagent.maddpg import MADDPG, MADDPGConfig
from bidex_algos.multiagent.mappo import MAPPO, MAPPOConfig
from bidex_algos.offpolicy.ddpg import DDPG, DDPGConfig
from bidex_algos.onpolicy.mtppo import MTPPO, MTPPOConfig
from bidex_algos.onpolicy.mttrpo import MTTRPO, MTTRPOConfig
from bidex_meta.errors import BidexError
from tests.algos.problems import LQR, opposite_bandits, trained
from tests.algos.toy import ToyWorld, nearness

PAIR = "a=action/0;b=action/1"
SMALL: dict[str, Any] = {"hidden": (16, 16), "rollout_steps": 8, "init_std": 0.5, "autocast": "off"}
KINDS: dict[str, tuple[Any, Any]] = {
    "ippo": (IPPO, IPPOConfig(agents=PAIR, **SMALL)),
    "mappo": (MAPPO, MAPPOConfig(agents=PAIR, **SMALL)),
    "happo": (HAPPO, HAPPOConfig(agents=PAIR, **SMALL)),
    "hatrpo": (HATRPO, HATRPOConfig(agents=PAIR, **SMALL)),
}
every = pytest.mark.parametrize("kind", KINDS)


def weights_of(learner: Any) -> Tensor:
    actor = learner.policy.actor
    net, log_std = (actor.nets[0], actor.log_stds[0]) if hasattr(actor, "nets") else (actor.mean, actor.log_std)
    return torch.cat([p.detach().flatten() for p in (*net.parameters(), log_std, *learner.critic.parameters())])


def assert_alike(one: Any, other: Any, iterations: int = 3) -> None:
    torch.testing.assert_close(weights_of(one), weights_of(other), rtol=0, atol=0)
    start = weights_of(one)
    for _ in range(iterations):
        told = [learner.iterate() for learner in (one, other)]
        for name in ("Loss/value", "Loss/surrogate", "Policy/kl"):
            assert told[0][name] == pytest.approx(told[1][name], abs=1e-5)
        torch.testing.assert_close(weights_of(one), weights_of(other), rtol=0, atol=1e-5)
    assert (weights_of(one) - start).abs().max() > 1e-3


@pytest.mark.parametrize("more", [{}, {"policy_heads": True}])
def test_mappo_of_one_agent_is_mt_ppo(more: dict[str, Any]) -> None:
    plain = MTPPO(opposite_bandits(), MTPPOConfig(**SMALL, **more), seed=1)
    config = MAPPOConfig(**SMALL, **more, agents="single", value_loss_weight=2.0)
    assert_alike(plain, MAPPO(opposite_bandits(), config, seed=1))


def test_hatrpo_of_one_agent_is_mt_trpo() -> None:
    shared: dict[str, Any] = {**SMALL, "max_kl": 0.05, "fisher_stride": 2}
    plain = MTTRPO(opposite_bandits(), MTTRPOConfig(**shared), seed=1)
    assert_alike(plain, HATRPO(opposite_bandits(), HATRPOConfig(**shared, agents="single"), seed=1))


@pytest.mark.parametrize("max_factor", [0.0, 1.1])
def test_the_factor_is_the_product_of_the_ratios_before(max_factor: float) -> None:
    config = HAPPOConfig(agents="a=action/2;b=action/3+action/0;c=action/1", max_factor=max_factor, **SMALL)
    learner = HAPPO(ToyWorld([nearness(0.3)], actions=4), config, seed=0)
    learner.iterate()
    batch, _ = learner._prepare()
    actor, own = learner.policy.actor, ([2], [0, 3], [1])

    def log_prob(agent: int) -> Tensor:
        mean, std = actor.nets[agent](batch.obs).detach(), actor.log_stds[agent].detach().exp()
        return Normal(mean, std).log_prob(batch.actions[:, own[agent]]).sum(1)

    orders = set()
    for _ in range(12):
        old, moved = [log_prob(i) for i in range(3)], []
        fresh, _ = learner._prepare()
        batch = replace(batch, old_means=actor(batch.obs).detach(), advantages=fresh.advantages)
        factor = torch.ones_like(batch.advantages)
        for agent, share in learner._in_turn(batch):
            torch.testing.assert_close(share.old_log_probs, old[agent], rtol=0, atol=1e-4)
            bounded = factor.clamp(max=max_factor) if max_factor else factor
            torch.testing.assert_close(share.gain, bounded * batch.advantages, rtol=1e-3, atol=1e-4)
            with torch.no_grad():
                for weight in actor.parameters_of(agent):
                    weight += 0.02 * torch.randn(weight.shape, generator=learner.generator)
            factor = factor * torch.exp(log_prob(agent) - old[agent])
            moved.append(agent)
        assert sorted(moved) == [0, 1, 2] and factor.max() > 1.2
        orders.add(tuple(moved))
    assert len(orders) > 2


@every
def test_two_tasks_by_two_agents(kind: str) -> None:
    make, config = KINDS[kind]
    faster = {"learning_rate": 3e-3} if kind != "hatrpo" else {"fisher_stride": 1}
    learner = trained(make, opposite_bandits(0.5), replace(config, **faster), 30)
    obs, _ = learner.world.reset(seed=1)
    for task, target in enumerate((0.5, -0.5)):
        means = learner.eval_action(obs)[learner.world.task_id == task].mean(0)
        assert means.tolist() == pytest.approx([target] * 2, abs=0.15)


LARGE: dict[str, Any] = {
    "clip": 5.0, "epochs": 15, "num_minibatches": 1, "adaptive_learning_rate": False, "learning_rate": 1e-2,
    "max_grad_norm": 100.0, "critic_learning_rate": 1e-2,
}  # fmt: skip


@pytest.mark.parametrize("seed", range(3))
@every
def test_a_matrix_game_needs_turns(kind: str, seed: int) -> None:
    """Both go at first, and for each it would be better to stop, unless the other does.

    With large steps agents that move at once both stop, then both go; in turns the second sees what the first has done.
    """
    make, config = KINDS[kind]
    in_turns = kind in ("happo", "hatrpo")
    far = {"max_kl": 3.0, "damping": 0.01, "fisher_stride": 1, "accept_ratio": 0.0, "critic_epochs": 2}
    world = ToyWorld([lambda action: (action > 0).sum(1).eq(1).float()], rows=512, horizon=1, terminal=True)
    learner = make(world, replace(config, std_range=(0.5, 0.5), **(far if kind == "hatrpo" else LARGE)), seed=seed)
    with torch.no_grad():
        for net in learner.policy.actor.nets:
            net.head.bias.fill_(0.4)
    paid = []
    for _ in range(5):
        learner.iterate()
        paid.append(float(learner.rollout.rewards.mean()))
    assert paid[0] < 0.4
    assert (sum(paid[1:4]) / 3 > 0.75 and paid[-1] > 0.85) if in_turns else sum(paid[1:4]) / 3 < 0.55


@pytest.mark.parametrize("share", [False, True])
def test_agents_of_one_form_in_one_pass(share: bool) -> None:
    config = MAPPOConfig(agents="a=action/3;b=action/0;c=action/1+action/2", share_parameters=share, **SMALL)
    actor = MAPPO(ToyWorld([nearness(0.3)], actions=4), config, seed=0).policy.actor
    assert len(actor.nets) == (2 if share else 3)
    x = torch.randn(7, 2)
    joint = actor(x)
    for agent, own in enumerate(([3], [0], [1, 2])):
        torch.testing.assert_close(joint[:, own], actor.distribution_of(agent, actor.seen(agent, x), x[:, :0])[0])
    if share:
        assert not torch.allclose(joint[:, 3], joint[:, 0])  # it reads who acts
    joint.sum().backward()
    assert all(weight.grad is not None for weight in actor.nets.parameters())


def test_ippos_critics_see_no_more_than_their_agents() -> None:
    from bidex_algos.multiagent.team import TeamCritic
    from bidex_meta.tasks import registry
    from bidex_meta.world.agent_views import agent_views
    from bidex_meta.world.observations import observation_groups

    layout = registry.get("CatchUnderarm").layout
    views = agent_views(observation_groups([layout], layout.size, 0), 52, "hands")
    critic = TeamCritic(views, IPPOConfig(**SMALL), 1, torch.Generator().manual_seed(0))
    x = torch.randn(3, layout.size, requires_grad=True)
    critic(x)[:, 0, 0].sum().backward()
    assert x.grad is not None and x.grad.ne(0).any(0).nonzero().flatten().tolist() == list(views[0].columns)


@every
def test_popart_keeps_values_when_statistics_change(kind: str) -> None:
    make, config = KINDS[kind]
    learner = make(opposite_bandits(scale=1000.0), replace(config, popart=True), seed=0)
    learner.iterate()
    obs, task_id = learner.rollout.last_obs, learner.world.task_id
    before = learner._final_value(obs, task_id).detach()
    stats = learner.return_stats
    learner._merge_returns(stats.mean * 3.0 + 50.0, stats.var * 9.0 + 1.0, torch.full_like(stats.mean, 1e4))
    torch.testing.assert_close(learner._final_value(obs, task_id).detach(), before, rtol=1e-4, atol=1e-3)
    assert float(before.std()) > 0.0


def test_bad_configs_are_one_line() -> None:
    with pytest.raises(BidexError, match="belongs to no agent"):
        MAPPO(LQR(), MAPPOConfig(agents="a=action/0", **SMALL), seed=0)
    with pytest.raises(BidexError, match="200 mini-batches need as many samples"):
        HAPPO(LQR(rows=2), HAPPOConfig(agents=PAIR, num_minibatches=200, **SMALL), seed=0)


CROSSED = "a=action/1;b=action/0"
REPLAYED: dict[str, Any] = {
    "hidden": (32, 32), "autocast": "off", "batch_size": 128, "learning_rate": 2e-3, "critic_learning_rate": 3e-3,
    "warmup_steps": 8, "replay_steps": 200, "policy_heads": False, "tau": 0.05, "squash_price": 0.0,
}  # fmt: skip


def rosenbrock(action: Tensor) -> Tensor:
    first, second = action.unbind(1)
    return 1.0 - 2.0 * (second - first.square()).square() - (first - 0.5).square()


def test_two_agents_find_a_coupled_optimum() -> None:
    world = ToyWorld([rosenbrock], rows=32, horizon=1, terminal=True)
    learner = trained(MADDPG, world, MADDPGConfig(agents=CROSSED, **REPLAYED), 25)
    obs, _ = world.reset(seed=1)
    assert learner.eval_action(obs).mean(0).tolist() == pytest.approx([0.5, 0.25], abs=0.1)


@pytest.mark.parametrize("heads", [False, True])
def test_one_agent_is_ddpg(heads: bool) -> None:
    options = REPLAYED | {"policy_heads": heads, "squash_price": 0.5}
    one, other = (
        DDPG(opposite_bandits(), DDPGConfig(**options), seed=1),
        MADDPG(opposite_bandits(), MADDPGConfig(agents="single", **options), seed=1),
    )
    for _ in range(3):
        told = [learner.iterate() for learner in (one, other)]
        assert told[0]["Loss/critic"] == pytest.approx(told[1]["Loss/critic"], abs=1e-5)
    weights = [torch.cat([p.detach().flatten() for p in each.policy.actor.parameters()]) for each in (one, other)]
    torch.testing.assert_close(*weights, rtol=0, atol=1e-5)

"""FlashSAC: its blocks, norms and weights, the joint batch, repeated noise."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

from bidex_algos.offpolicy.flashsac import FlashSAC, FlashSACConfig, InvertedBlock, UnitMLP, by_batch
from tests.algos.problems import OFF_POLICY, PointMass, a_draw, discounted_return, opposite_bandits, shake, trained
from tests.algos.test_fasttd3_brc import projected
from tests.algos.test_offpolicy import FLASH
from tests.algos.toy import ToyWorld, nearness

SMALL: dict[str, Any] = {"hidden": (16, 16), "critic_hidden": (32, 32), "atoms": 51, "updates_per_step": 2}
CONFIG = FlashSACConfig(**OFF_POLICY | SMALL, n_steps=1)


def drawn(*shape: int, seed: int = 1) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def network(inputs: int = 3, outputs: int = 2) -> UnitMLP:
    return UnitMLP(inputs, (8, 8, 8), outputs, 0.01, torch.Generator().manual_seed(0), "relu")


def units(module: nn.Module) -> list[Tensor]:
    """What must be 1: lengths of rows of weights, the root mean square of a norm's scales plus that of its shifts."""
    found = []
    for net in (net for net in module.modules() if isinstance(net, UnitMLP)):
        for layer in net.modules():
            if isinstance(layer, nn.Linear):
                found.append(layer.weight.norm(dim=1))
            elif isinstance(layer, (nn.BatchNorm1d, nn.RMSNorm)):
                found.append(sum(weight.square().mean() for weight in layer.parameters()).sqrt()[None])  # type: ignore[union-attr]
    return [x.detach() for x in found]


def test_a_network_in_training_is_that_of_the_formula() -> None:
    net, x = network(), 5.0 + 3.0 * drawn(6, 3)

    def normal(y: Tensor) -> Tensor:
        return (y - y.mean(0)) / (y.var(0, correction=0) + 1e-5).sqrt()

    weights = [layer.weight for layer in net.modules() if isinstance(layer, nn.Linear)]
    assert [tuple(w.shape) for w in weights] == [(8, 3), (32, 8), (8, 32), (32, 8), (8, 32), (2, 8)]
    y = normal(x) @ weights[0].T
    for first, second in (weights[1:3], weights[3:5]):
        y = y + normal(normal(y @ first.T).relu() @ second.T).relu()
    y = y / y.square().mean(1, keepdim=True).sqrt()
    with by_batch(net):
        assert_close(net(x), y @ weights[5].T, rtol=1e-4, atol=1e-5)
    assert not net.training


def test_running_statistics_are_those_of_the_formula_and_hold_outside_of_training() -> None:
    net, x = network(), 5.0 + 3.0 * drawn(6, 3)
    before = net(x)
    assert_close(net(x), before, rtol=0, atol=0)
    with by_batch(net):
        net(x)
    norm: Any = net.body[0]
    mean, var = 0.01 * x.mean(0), 0.99 + 0.01 * x.var(0)
    assert_close(norm.running_mean, mean)
    assert_close(norm.running_var, var)
    assert_close(norm(x), (x - mean) / (var + 1e-5).sqrt())
    # A single row gives the same result as in a batch.
    assert_close(net(x)[:1], net(x[:1]))


def test_a_block_adds_the_same_however_large_its_input() -> None:
    block = InvertedBlock(8, torch.Generator().manual_seed(0), "relu")
    x = drawn(16, 8)
    small, large = block(x) - x, block(1000.0 * x) - 1000.0 * x
    assert_close(small, large, rtol=1e-3, atol=1e-3)


def test_weights_are_of_length_1_after_every_update() -> None:
    learner = FlashSAC(opposite_bandits(rows=8), replace(CONFIG, learning_rate=0.05, critic_learning_rate=0.05), seed=0)
    for _ in range(2):
        for part in (learner.policy.actor, learner.critic):
            assert len(units(part)) == 8 * (1 if part is learner.policy.actor else 2)
            for length in units(part):
                assert_close(length, torch.ones_like(length))
        learner.iterate()


def test_the_target_is_that_of_the_definition_by_a_joint_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    world = ToyWorld([nearness(0.5), nearness(-0.5)], rows=3)
    config = replace(CONFIG, gamma=0.7, batch_per_task=3, cut_share=1.0, value_bound=10.0)
    learner, draw = FlashSAC(world, config, seed=0), a_draw(-3.0, (1, 2, 3, 1, 1, 3))
    shake(learner.target_critic)
    with torch.no_grad():
        learner.log_alpha.copy_(torch.tensor([0.1, 0.9]).log())
    learner.returns.stats.var.copy_(torch.tensor([4.0, 0.25]))
    learner.returns.bound.copy_(torch.tensor([1.0, 50.0]))  # deviation 2 counts, and 50 / 10
    again = learner.generator.clone_state()
    actions, log_prob = learner.policy.sample(draw.next_obs, again)
    both = torch.cat([torch.cat([draw.obs, draw.next_obs]), torch.cat([draw.actions, actions])], dim=1).detach()
    probs = torch.stack([net(both).detach().double().softmax(1) for net in learner.target_critic.nets])[:, 6:]
    lower = (probs * torch.linspace(-10, 10, 51).double()).sum(2).argmin(0)
    assert 0 < lower.sum() < 6
    rewards = draw.rewards / torch.tensor([2.0] * 3 + [5.0] * 3)
    bonus = -torch.tensor([0.1] * 3 + [0.9] * 3) * log_prob.detach()
    expected = projected(learner, draw, rewards, probs[lower, torch.arange(6)], bonus)
    logs = torch.stack([learner.critic.nets[i].train()(both).log_softmax(1)[:6] for i in (0, 1)])
    learner.critic.eval()
    found: list[Tensor] = []

    def kept(obs: Tensor, actions: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        losses, values = FlashSAC._critic_losses(learner, obs, actions, target)
        found.extend([target, losses.detach()])
        return losses, values

    monkeypatch.setattr(learner, "_critic_losses", kept)
    learner._update(draw, torch.ones(6), torch.full((2,), 3.0))
    assert_close(found[0].double(), expected, rtol=1e-4, atol=1e-5)
    assert_close(found[1].double(), -(expected * logs.detach()).sum(2), rtol=1e-4, atol=1e-5)


def test_the_actor_waits_for_the_critics() -> None:
    learner, draw = FlashSAC(opposite_bandits(rows=6), replace(CONFIG, batch_per_task=3), seed=0), a_draw()
    moved = []
    for _ in range(4):
        before = [p.detach().clone() for p in learner.policy.actor.parameters()]
        learner._update(draw, torch.ones(6), torch.full((2,), 3.0))
        after = learner.policy.actor.parameters()
        moved.append(any(not torch.equal(a, b) for a, b in zip(before, after, strict=True)))
    assert moved == [True, False, True, False]


def test_noise_stays_as_long_as_drawn_and_then_is_new() -> None:
    learner = FlashSAC(opposite_bandits(rows=2000), replace(CONFIG, noise_repeats=4), seed=0)
    obs = torch.zeros(4000, 3)
    noise = []
    for _ in range(60):
        learner._explore(obs)
        noise.append(learner.noise[:, 0])
    stays = (torch.stack(noise[1:]) == torch.stack(noise[:-1])).double()
    # Lengths 1 to 4 have probabilities in proportion to 1, 1/4, 1/9, 1/16, which gives this share of continuing steps.
    shares = torch.arange(1.0, 5.0) ** -2
    mean = float((shares / shares.sum() * torch.arange(1.0, 5.0)).sum())
    assert float(stays.mean()) == pytest.approx(1.0 - 1.0 / mean, abs=0.01)
    longest = (stays[:-3] * stays[1:-2] * stays[2:-1] * stays[3:]).sum()
    assert longest == 0 and (stays[:-2] * stays[1:-1] * stays[2:]).sum() > 0
    assert_close(torch.stack(noise).std(), torch.tensor(1.0), rtol=0.02, atol=0)


def test_without_repeats_noise_is_new_at_every_step() -> None:
    learner = FlashSAC(opposite_bandits(rows=8), replace(CONFIG, noise_repeats=1), seed=0)
    obs = torch.zeros(16, 3)
    assert (learner._explore(obs) != learner._explore(obs)).all()


def test_a_point_is_brought_to_its_goal() -> None:
    # In the LQR the worst states have the largest absolute return, so all other states share an atom.
    learner = trained(FlashSAC, PointMass(), FLASH, 14)
    best = discounted_return(PointMass(rows=256), learner.world.best, 0.8, 40)
    assert discounted_return(PointMass(rows=256), lambda obs: torch.zeros(len(obs), 2), 0.8, 40) < 2.5 * best
    assert discounted_return(PointMass(rows=256), learner.eval_action, 0.8, 40) > 1.3 * best


def test_a_loaded_policy_acts_by_the_running_statistics() -> None:
    learner = trained(FlashSAC, opposite_bandits(rows=8), CONFIG, 2)
    policy, obs = FlashSAC.load_policy(learner.policy_state_dict()), drawn(5, 3)
    norms = [m for m in policy.modules() if isinstance(m, nn.BatchNorm1d)]
    assert all((norm.running_mean != 0).any() and not norm.training for norm in norms)
    assert torch.equal(policy.eval_action(obs), learner.eval_action(obs))
    assert_close(policy.eval_action(obs)[:1], policy.eval_action(obs[:1]))

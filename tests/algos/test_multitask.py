"""What several tasks share: networks, and the way of their losses to shared weights, against closed forms."""

import math
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from bidex_algos.balancing import Famo, conflict_averse, project_conflicting, worst_served
from bidex_algos.nets.architecture import network_of
from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.multitask import Moore, PaCo, SoftModules, Towers, Transformer, gram_schmidt
from bidex_algos.nets.networks import MLP
from bidex_algos.onpolicy.mtppo import MTPPO, MTPPOConfig
from bidex_meta.world.contract import ObservationGroup
from tests.algos.problems import opposite_bandits

TRUNKS = {"soft_modules": SoftModules, "paco": PaCo, "moore": Moore, "transformer": Transformer}
TRUNKS |= {"towers": partial(Towers, shared=1), "separate": partial(Towers, shared=0)}
# The task id is in the middle, because no code may assume that it is last.
GROUPS = (ObservationGroup("state", (slice(0, 3), slice(6, 9))), ObservationGroup("task_id", (slice(3, 6),)))
TASKS = torch.arange(8) % 3


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def made(name: str, hidden: tuple[int, ...] = (16, 12, 12), modules: int = 4, **options: Any) -> Any:
    return TRUNKS[name](Inputs(GROUPS), hidden, 5, 1.0, generator(), modules=modules, **options)


def observations(seed: int = 1) -> torch.Tensor:
    x = torch.randn(8, 9, generator=generator(seed))
    x[:, 3:6] = torch.eye(3)[TASKS]
    return x


@pytest.mark.parametrize("name", TRUNKS)
@pytest.mark.parametrize("layer_norm", [False, True])
def test_gradients_reach_every_weight_and_the_task_decides(name: str, layer_norm: bool):
    network, x = made(name, layer_norm=layer_norm), observations()
    out = network(x)
    assert out.shape == (8, 5) and out.dtype == torch.float32
    out.square().sum().backward()
    for weight_name, weight in network.named_parameters():
        gradient = weight.grad
        assert gradient is not None and gradient.abs().sum() > 0, weight_name
        if weight.dim() == 3:  # each of the modules
            assert (gradient.abs().sum((1, 2)) > 0).all(), weight_name
    other = x.clone()
    other[:, 3:6] = torch.eye(3)[(TASKS + 1) % 3]
    assert not torch.isclose(network(other), out).all(1).any()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 6), st.sampled_from([1.0, 1e-2, 1e-4]))
def test_gram_schmidt_is_orthonormal_and_spans_the_same(seed: int, count: int, apart: float):
    common = torch.randn(1, 7, 16, generator=generator(seed))
    vectors = common + apart * torch.randn(count, 7, 16, generator=generator(seed + 1))  # nearly parallel
    found = gram_schmidt(vectors)
    products = torch.einsum("ibn,jbn->bij", found, found)
    assert_close(products, torch.eye(count).expand(7, -1, -1), rtol=0, atol=1e-5)
    rest = vectors - torch.einsum("ibn,jbn,jbm->ibm", vectors, found, found)
    assert rest.abs().max() < 1e-5
    assert_close(found[0], vectors[0] / vectors[0].norm(dim=-1, keepdim=True))


def test_moores_experts_are_orthogonal_and_mixed_by_the_tasks_weights():
    network, x = made("moore"), observations()
    experts = network.experts(x)
    assert_close(torch.einsum("ibn,jbn->bij", experts, experts), torch.eye(4).expand(8, -1, -1), rtol=0, atol=1e-5)
    weights = network.weights.rows[TASKS]
    together = sum((weights[:, k, None] * experts[k] for k in range(4)), torch.zeros(8, 12))
    hidden = torch.nn.functional.elu(12**0.5 * together)
    assert_close(network(x), network.head(hidden))


@pytest.mark.parametrize("hidden", [(16, 12), (16, 12, 10), (16, 12, 10, 8)])
def test_soft_routes_sum_to_one_and_follow_the_paper(hidden: tuple[int, ...]):
    network, x = made("soft_modules", hidden, modules=3), observations()
    state = network.embedded(x)
    routes = network.routes(x, state)
    assert [tuple(r.shape) for r in routes] == [(8, 3, 3)] * (len(hidden) - 2) + [(8, 1, 3)]
    for shares in routes:
        assert_close(shares.sum(-1), torch.ones(shares.shape[:2]))
    # One row is computed by hand, module by module.
    row, both = 4, state[4] * network.task(torch.eye(3)[TASKS[4]])
    logits, given = network.down[0](both.relu()), [state[row]] * 3
    for number, layer in enumerate(network.layers):
        given = [torch.nn.functional.elu(w @ g + b) for w, b, g in zip(layer.weight, layer.bias, given, strict=True)]
        table = logits.view(-1, 3)
        given = [sum(p * g for p, g in zip(shares.softmax(0), given, strict=True)) for shares in table]
        if number < len(network.up):
            logits = network.down[number + 1]((network.up[number](logits) * both).relu())
    assert_close(network.head(given[0]), network(x)[row])


@pytest.mark.parametrize(("name", "hidden"), [("towers", (16,)), ("towers", (16, 12)), ("separate", (16, 12))])
def test_a_tower_reads_and_learns_its_own_task_alone(
    name: str, hidden: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
):
    network, x = made(name, hidden), observations()
    state = x[:, [0, 1, 2, 6, 7, 8]]
    for layer in network.common:
        state = torch.nn.functional.elu(layer(state))
    for layer in network.own:
        rows = zip(state, layer.weight[TASKS], layer.bias[TASKS], strict=True)
        state = torch.stack([torch.nn.functional.elu(w @ row + b) for row, w, b in rows])
    out = network(x)
    assert_close(out, network.head(state))
    out[TASKS == 1].sum().backward()
    assert all((layer.weight.grad.abs().sum((1, 2)) > 0).tolist() == [False, True, False] for layer in network.own)
    monkeypatch.setattr("bidex_meta.utils.maths.may_look", lambda device: False)  # as on a GPU
    assert_close(network(x), out)


def test_pacos_layers_are_those_of_the_composed_parameters():
    network, x = made("paco", (16,), modules=5), observations()
    for task in range(3):
        weights = network.weights.rows[task]
        [layer] = network.layers
        first, bias = torch.einsum("k,koi->oi", weights, layer.weight), weights @ layer.bias
        last = torch.einsum("k,koi->oi", weights, network.head.weight)
        state = x[task == TASKS][:, [0, 1, 2, 6, 7, 8]]
        expected = torch.nn.functional.elu(state @ first.T + bias) @ last.T + network.output_bias
        assert_close(network(x)[task == TASKS], expected)


PPO = MTPPOConfig(
    hidden=(32, 32), rollout_steps=8, learning_rate=1e-3, learning_rate_range=(1e-4, 4e-3), std_range=(0.05, 1.0),
    autocast="off",
)  # fmt: skip


def test_multi_head_is_the_shared_trunk_with_both_heads():
    heads = MTPPO(opposite_bandits(), replace(PPO, architecture="multi_head", value_heads=False), seed=0)
    plain = MTPPO(opposite_bandits(), replace(PPO, policy_heads=True, value_heads=True), seed=0)
    for a, b in zip(heads.policy.parameters(), plain.policy.parameters(), strict=True):
        assert torch.equal(a, b)
    assert heads.critic.head.weight.shape == plain.critic.head.weight.shape == (2, 32)


def test_a_checkpoint_with_other_options_loads():
    learner = MTPPO(opposite_bandits(), PPO, seed=0)
    learner.iterate()
    state = learner.state_dict()
    del state["policy"]["config"]["architecture"]
    state["policy"]["config"]["modules"] = 4  # an option that a later version dropped
    policy = MTPPO.load_policy(state["policy"])
    obs, _ = learner.world.reset(seed=1)
    assert torch.equal(policy.eval_action(obs), learner.eval_action(obs))
    assert isinstance(network_of(PPO)(4, (8,), 1, 1.0, generator()), MLP)


seeds = st.integers(0, 2**31)


def draw(seed: int, tasks: int, entries: int = 5) -> torch.Tensor:
    return torch.randn(tasks, entries, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@settings(max_examples=60, deadline=None)
@given(
    seeds, st.integers(2, 20), st.integers(1, 30), st.integers(1, 30), st.floats(-4, 0), st.floats(0.05, 0.95),
    st.sampled_from([1.0, 0.1, 0.01]),
)  # fmt: skip
@example(296, 16, 17, 6, -1.16, 0.87, 1.0)  # a descent along pairs of weights ended 0.4 below, in squares of the mean
@example(4, 12, 30, 30, -1.0, 0.4, 0.01)  # 24 halvings of the barrier ended 20 below
def test_no_direction_serves_the_worst_served_task_better_than_cagrads(
    seed: int, tasks: int, entries: int, rank: int, apart: float, c: float, left: float
):
    # The matrices have low rank or are nearly parallel, and sizes differ tenfold. ``left`` is what is left of the mean.
    gradients = draw(seed, 1, entries) * (apart < -2) + 10**apart * draw(seed, tasks, rank) @ draw(seed, rank, entries)
    gradients *= torch.logspace(0, 1, tasks, dtype=torch.float64)[:, None]
    gradients -= (1 - left) * gradients.mean(0)
    gram, even = gradients @ gradients.T, torch.full((tasks,), 1 / tasks, dtype=torch.float64)
    length = gradients.mean(0).norm()
    direction = conflict_averse(gradients, c)[0] / tasks
    assert (direction - gradients.mean(0)).norm() <= (c + 1e-6) * length
    # For any weights, the dual value is at least the value of every direction.
    weights = worst_served(gram, even, c * length)
    assert weights.min() >= 0 and weights.sum() == pytest.approx(1, abs=1e-5)
    weights /= weights.sum()
    best = weights @ gram @ even + c * length * (weights @ gram @ weights).clamp_min(0.0).sqrt()
    assert (gradients @ direction).min() >= best - 1e-4 * length.square()


def test_cagrad_without_a_radius_or_a_conflict_is_the_sum():
    gradients = draw(0, 4)
    assert_close(conflict_averse(gradients, 0.0)[0], gradients.sum(0))
    same = gradients[:1].expand(3, -1)
    assert_close(conflict_averse(same, 0.4)[0], 1.4 * same.sum(0))
    assert torch.equal(conflict_averse(torch.zeros(3, 5), 0.4)[0], torch.zeros(5))
    assert_close(conflict_averse(gradients[:1], 0.4)[0], 1.4 * gradients[0])


def test_famo_of_two_losses_is_the_closed_form():
    # The losses are l_i = a_i x_i^2 above the minimum 0, each with its own coordinate.
    famo, a, x = Famo(2, rate=0.1, decay=0.0, device=torch.device("cpu")), torch.tensor([1.0, 8.0]), torch.ones(2)
    with torch.no_grad():
        famo.logits.copy_(torch.tensor([0.3, -0.2]))
    z = [1 / (1 + math.exp(-0.5)), 1 / (1 + math.exp(0.5))]
    losses = a * x.square()
    weights = famo.weights(losses)
    total = z[0] / 1.0 + z[1] / 8.0
    assert weights.tolist() == pytest.approx([2 * z[0] / 1.0 / total, 2 * z[1] / 8.0 / total])
    # Apart from its length, the direction is the gradient of the mean of log l_i, weighted by z.
    slope = weights * 2 * a * x
    assert float(slope[0] / slope[1]) == pytest.approx(z[0] / z[1])
    # The first loss falls to a quarter and the second stays, so the second must gain weight, by J' (log 4, 0).
    famo.learn(lambda: losses * torch.tensor([0.25, 1.0]))
    fallen = math.log(4.0)
    expected = [z[0] * (1 - z[0]) * fallen, -z[1] * z[0] * fallen]
    gradient = famo.logits.grad
    assert gradient is not None and gradient.tolist() == pytest.approx(expected)
    # Adam's first step is as long as its rate, against the gradient.
    assert famo.logits.tolist() == pytest.approx([0.3 - 0.1, -0.2 + 0.1], abs=1e-5)


def test_famo_leaves_out_a_task_without_samples():
    famo = Famo(3, rate=0.1, decay=0.0, device=torch.device("cpu"))
    weights = famo.weights(torch.tensor([1.0, 0.0, 1.0]))
    assert_close(weights, torch.tensor([1.5, 0.0, 1.5]))
    famo.learn(lambda: torch.tensor([0.5, 3.0, 0.5]))
    assert famo.logits[1] > famo.logits[0] == famo.logits[2]


def in_a_loop(gradients: Tensor) -> Tensor:
    total = torch.zeros_like(gradients[0])
    for i in range(len(gradients)):
        left = gradients[i].clone()
        for shift in range(1, len(gradients)):
            other = gradients[(i + shift) % len(gradients)]
            if left @ other < 0:
                left = left - (left @ other) / (other @ other) * other
        total = total + left
    return total


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 6))
def test_surgery_equals_the_loop_over_tasks(seed: int, tasks: int):
    gradients = torch.randn(tasks, 7, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    assert_close(project_conflicting(gradients)[0], in_a_loop(gradients))

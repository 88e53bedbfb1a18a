"""Networks that share weights between tasks: soft modules, PaCo, MOORE, heads; alone and in the learners."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from bidex_algos.nets.architecture import network_of
from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.multitask import Moore, PaCo, SoftModules, gram_schmidt
from bidex_algos.nets.networks import MLP
from bidex_algos.offpolicy.fasttd3 import FastTD3Config
from bidex_algos.onpolicy.mtppo import MTPPO, MTPPOConfig
from bidex_meta.errors import BidexError
from bidex_meta.world.contract import ObservationGroup
from tests.algos.problems import opposite_bandits

TRUNKS = {"soft_modules": SoftModules, "paco": PaCo, "moore": Moore}
# The task id stands in the middle: nothing may assume that it is last.
GROUPS = (ObservationGroup("state", (slice(0, 3), slice(6, 9))), ObservationGroup("task_id", (slice(3, 6),)))
TASKS = torch.arange(8) % 3


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def made(name: str, hidden: tuple[int, ...] = (16, 12, 10), modules: int = 4, **options: Any) -> Any:
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
    together = sum((weights[:, k, None] * experts[k] for k in range(4)), torch.zeros(8, 10))
    hidden = torch.nn.functional.elu(10**0.5 * together)
    assert_close(network(x), network.head(hidden))


@pytest.mark.parametrize("hidden", [(16, 12), (16, 12, 10), (16, 12, 10, 8)])
def test_soft_routes_sum_to_one_and_follow_the_paper(hidden: tuple[int, ...]):
    network, x = made("soft_modules", hidden, modules=3), observations()
    state = network.embedded(x)
    routes = network.routes(x, state)
    assert [tuple(r.shape) for r in routes] == [(8, 3, 3)] * (len(hidden) - 2) + [(8, 1, 3)]
    for shares in routes:
        assert_close(shares.sum(-1), torch.ones(shares.shape[:2]))
    # One row by hand, module by module.
    row, both = 4, state[4] * network.task(torch.eye(3)[TASKS[4]])
    logits, given = network.down[0](both.relu()), [state[row]] * 3
    for number, layer in enumerate(network.layers):
        given = [torch.nn.functional.elu(w @ g + b) for w, b, g in zip(layer.weight, layer.bias, given, strict=True)]
        table = logits.view(-1, 3)
        given = [sum(p * g for p, g in zip(shares.softmax(0), given, strict=True)) for shares in table]
        if number < len(network.up):
            logits = network.down[number + 1]((network.up[number](logits) * both).relu())
    assert_close(network.head(given[0]), network(x)[row])


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


# In the learners.

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


def test_a_checkpoint_from_before_there_were_architectures_loads():
    learner = MTPPO(opposite_bandits(), PPO, seed=0)
    learner.iterate()
    state = learner.state_dict()
    for name in ("architecture", "modules", "cagrad_radius", "famo_rate", "famo_decay"):
        del state["policy"]["config"][name]
    policy = MTPPO.load_policy(state["policy"])
    obs, _ = learner.world.reset(seed=1)
    assert torch.equal(policy.eval_action(obs), learner.eval_action(obs))
    assert isinstance(network_of(PPO)(4, (8,), 1, 1.0, generator()), MLP)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"architecture": "paco", "task_embedding": 4}, "task_embedding goes with architecture shared"),
        ({"architecture": "soft_modules", "hidden": (32,)}, "at least two widths"),
        ({"architecture": "moore", "hidden": (32, 3)}, "no more modules than the last width"),
        ({"architecture": "moore", "hidden": ()}, "no more modules than the last width"),
    ],
)
def test_what_does_not_go_together_is_refused(options: dict[str, Any], message: str):
    with pytest.raises(BidexError, match=message):
        replace(PPO, **options)


def test_the_critics_own_widths_are_checked_too():
    with pytest.raises(BidexError, match="two widths in critic_hidden"):
        FastTD3Config(architecture="soft_modules", critic_hidden=(64,))

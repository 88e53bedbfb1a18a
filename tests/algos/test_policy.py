import math

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution
from torch.testing import assert_close

from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.policy import SquashedActor, sample_squashed
from bidex_meta.world.contract import plain_groups


def actor(heads: int = 1, init_std: float = 0.5, std_range: tuple[float, float] = (0.02, 2.0)) -> SquashedActor:
    inputs, g = Inputs(plain_groups(5, 2)), torch.Generator().manual_seed(0)
    return SquashedActor(inputs, (16,), 3, heads, init_std, std_range, g, "relu")


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 6))
def test_the_density_agrees_with_torch_distributions(seed: int, actions: int):
    g = torch.Generator().manual_seed(seed)
    mean, log_std, noise = 0.7 * torch.randn(3, 5, actions, generator=g, dtype=torch.float64)
    action, log_prob = sample_squashed(mean, log_std, noise)
    # The one with the cached inverse: what torch computes from an action near 1 is itself inexact.
    squashed = TransformedDistribution(Normal(mean, log_std.exp()), TanhTransform(cache_size=1))
    expected = Independent(squashed, 1).log_prob(action)
    assert_close(log_prob, expected, rtol=1e-6, atol=1e-6)


def test_value_and_gradient_stay_finite_where_tanh_rounds_to_one():
    mean = torch.tensor([[50.0, -50.0, 0.0]], requires_grad=True)
    log_std = torch.zeros(1, 3, requires_grad=True)
    action, log_prob = sample_squashed(mean, log_std, torch.ones(1, 3))
    assert action[0, 0] == 1.0
    # Far out the slope of tanh is 4 exp(-2|u|).
    expected = -1.5 - 1.5 * math.log(2 * math.pi) + (2 * 51 - math.log(4)) + (2 * 49 - math.log(4)) + 0.8675617
    assert_close(log_prob, torch.tensor([expected]), rtol=1e-5, atol=1e-4)
    (log_prob + action.sum()).sum().backward()
    assert mean.grad is not None and log_std.grad is not None
    assert mean.grad.isfinite().all() and log_std.grad.isfinite().all()


def test_the_actor_starts_at_zero_with_its_standard_deviation_and_keeps_the_bounds():
    mean, log_std = actor()(torch.randn(100, 5, generator=torch.Generator().manual_seed(0)))
    assert mean.abs().max() < 0.1
    assert_close(log_std.exp(), torch.full((100, 3), 0.5), rtol=0.1, atol=0)
    wild = actor()
    with torch.no_grad():
        wild.net.head.weight.mul_(1e6)
    std = wild(torch.randn(100, 5))[1].exp()
    assert 0.0199 < std.min() < 0.021 and 1.9 < std.max() < 2.001

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings
from torch import Tensor, nn
from torch.testing import assert_close

from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import GaussianActor, gaussian_kl
from bidex_algos.trust_region import conjugate_gradient, fisher_product, flatten, line_search
from bidex_meta.world.contract import plain_groups


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 12))
def test_conjugate_gradients_solve_a_linear_system(seed: int, size: int):
    g = torch.Generator().manual_seed(seed)
    root, b = (torch.randn(size, n, generator=g, dtype=torch.float64) for n in (size, 1))
    matrix, b = root @ root.T + torch.eye(size, dtype=torch.float64), b[:, 0]
    # Once solved, further iterations change nothing.
    for iterations in (2 * size, 10 * size):
        x = conjugate_gradient(lambda v: matrix @ v, b, iterations, tolerance=1e-24)
        assert_close(x, torch.linalg.solve(matrix, b), rtol=1e-6, atol=1e-8)


def test_zero_on_the_right_gives_zero():
    assert torch.equal(conjugate_gradient(lambda v: 2 * v, torch.zeros(3), 5), torch.zeros(3))


@pytest.mark.parametrize("heads", [1, 2])
def test_fisher_products_are_those_of_the_hessian_of_the_kl(heads: int):
    g = torch.Generator().manual_seed(0)
    actor = GaussianActor(Inputs(plain_groups(3, 2)), (4,), 2, 0.5, g, "tanh", heads).double()
    one_hot = torch.eye(2, dtype=torch.float64)[torch.tensor([0, 1, 0, 1, 1])]
    obs = torch.cat([torch.randn(5, 1, generator=g, dtype=torch.float64), one_hot], dim=1)
    parameters = list(actor.parameters())
    names, shapes = [n for n, _ in actor.named_parameters()], [p.shape for p in parameters]
    mean_p, log_std_p = actor(obs).detach(), actor.log_std_of(obs).detach()

    def kl_at(vector: Tensor) -> Tensor:
        parts = vector.split([p.numel() for p in parameters])
        values = {n: v.view(s) for n, v, s in zip(names, parts, shapes, strict=True)}
        mean = torch.func.functional_call(actor, values, (obs,))
        rows = values["log_std"] if heads == 1 else one_hot @ values["log_std"]
        return gaussian_kl(mean_p, log_std_p, mean, rows).mean()

    start = flatten(parameters).detach()
    hessian = torch.autograd.functional.hessian(kl_at, start)
    assert isinstance(hessian, Tensor)
    kl = gaussian_kl(mean_p, log_std_p, actor(obs), actor.log_std_of(obs)).mean()
    product = fisher_product(kl, parameters, damping=0.3)
    v = torch.randn(len(start), generator=g, dtype=torch.float64)
    assert_close(product(v), hessian @ v + 0.3 * v)


@pytest.mark.parametrize(
    ("objective", "kl", "asked", "found"),
    [
        (lambda m: m, lambda m: m * m, {}, (1.0, 3.0)),  # what keeps its promise is taken whole
        (lambda m: m, lambda m: 5 * m, {}, (0.125, 2.125)),  # back until the KL is kept
        # At 1 it has risen by 0.05 of the promised 1, at 0.5 by 0.31 of 0.5.
        (lambda m: 1.2 * m - 1.15 * m * m, lambda m: 0.0, {"accept_ratio": 0.5}, (0.5, 2.5)),
        *((worse, lambda m: 0.0, {}, (0.0, 2.0)) for worse in (lambda m: -m, lambda m: float("nan") if m else 0.0)),
    ],
)
def test_the_search_goes_back_as_far_as_it_must(objective, kl, asked, found):
    x = nn.Parameter(torch.tensor([2.0]))

    def measure() -> tuple[float, float]:
        moved = float(x.detach()) - 2.0
        return objective(moved), kl(moved)

    asked = {"expected": 1.0, "max_kl": 1.0, "accept_ratio": 0.1, "factor": 0.5, "tries": 5} | asked
    assert (line_search([x], torch.ones(1), measure, **asked), float(x.detach())) == found

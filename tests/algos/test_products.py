"""Products by oneDNN against PyTorch's own: values, gradients, gradients of gradients."""

import pytest
import torch
from torch.func import grad
from torch.testing import assert_close

from bidex_algos.nets import products
from bidex_algos.nets.products import Linear, affine, stacked_affine

ROWS, INPUTS, OUTPUTS = 8, 6, 5


@pytest.fixture(params=["own", "onednn"])
def chosen(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Rows of the products that oneDNN makes, in whichever way the machine would choose."""
    made: list[int] = []
    computed = products._onednn

    def counted(x, weight, bias):
        made.append(len(x))
        return computed(x, weight, bias)

    if request.param == "onednn":
        try:
            computed(torch.ones(2, 3), torch.ones(2, 3), None)
        except (AttributeError, RuntimeError):
            pytest.skip("PyTorch without oneDNN's product")
        monkeypatch.setattr(products, "_LEAST", 1)
    monkeypatch.setattr(products, "is_faster_here", lambda: request.param == "onednn")
    monkeypatch.setattr(products, "_onednn", counted)
    return made


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).requires_grad_()


@pytest.mark.parametrize("shape", [(ROWS, INPUTS), (2, ROWS // 2, INPUTS), (INPUTS,)])
@pytest.mark.parametrize("biased", [True, False])
def test_values_and_gradients_are_those_of_double_precision(chosen, shape, biased) -> None:
    x, weight = drawn(*shape), drawn(OUTPUTS, INPUTS, seed=1)
    bias = drawn(OUTPUTS, seed=2) if biased else None
    leaves = [x, weight] + [bias] * biased
    out = affine(x, weight, bias)
    doubles = [leaf.detach().double().requires_grad_() for leaf in leaves]
    expected = torch.nn.functional.linear(*doubles)
    assert_close(out.double(), expected, rtol=1e-5, atol=1e-5)
    found = torch.autograd.grad(out.square().sum(), leaves)
    for one, other in zip(found, torch.autograd.grad(expected.square().sum(), doubles), strict=True):
        assert_close(one.double(), other, rtol=1e-5, atol=1e-4)
    with torch.no_grad():
        assert torch.equal(affine(x, weight, bias), out)


def test_gradients_have_gradients(chosen) -> None:
    """What MAML's outer loop and TRPO's curvature need, by autograd and by ``torch.func``."""
    x, first, second = drawn(ROWS, INPUTS), drawn(INPUTS, INPUTS, seed=1), drawn(OUTPUTS, INPUTS, seed=2)

    def stepped(product, x, first, second):
        def loss(weight):
            return product(torch.tanh(product(x, weight)), second).square().sum()

        return loss(first - 0.1 * grad(loss)(first))

    found = torch.autograd.grad(stepped(affine, x, first, second), (first, second))
    doubles = [t.detach().double().requires_grad_() for t in (x, first, second)]
    expected = torch.autograd.grad(stepped(torch.nn.functional.linear, *doubles), doubles[1:])
    for one, other in zip(found, expected, strict=True):
        assert_close(one.double(), other, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("view", ["rows", "columns", "expanded", "middle"])
def test_operands_are_without_gaps(view) -> None:
    """What soft modules and MOORE hand on: slices of stacks, which oneDNN would multiply by its slowest code."""
    x = torch.arange(60.0).view(4, 3, 5)
    given = {"rows": x[0], "columns": x[0].t(), "expanded": x[0, :1].expand(3, 5), "middle": x[:, 1]}[view]
    dense = products._dense(given)
    assert torch.equal(dense, given) and (dense.is_contiguous() or dense.t().is_contiguous())
    assert (dense.data_ptr() == given.data_ptr()) == (view in ("rows", "columns"))


def test_layers_side_by_side(chosen) -> None:
    x, weight, bias = drawn(3, ROWS, INPUTS), drawn(3, OUTPUTS, INPUTS, seed=1), drawn(3, OUTPUTS, seed=2)
    out = stacked_affine(x, weight, bias)
    assert_close(out, torch.stack([torch.nn.functional.linear(*each) for each in zip(x, weight, bias, strict=True)]))
    assert_close(stacked_affine(x, weight) + bias[:, None], out)


@pytest.mark.filterwarnings("ignore:TF32")  # what flags() says of Intel's GPUs
def test_small_products_other_types_and_what_is_turned_off_are_pytorchs(chosen, monkeypatch) -> None:
    layer, x = Linear(INPUTS, OUTPUTS), drawn(ROWS, INPUTS)
    layer(x)
    made = list(chosen)
    layer.double()(x.double())
    with torch.backends.mkldnn.flags(enabled=False):
        layer.float()(x)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert layer(x).dtype == torch.bfloat16
    monkeypatch.setattr(products, "_LEAST", ROWS * INPUTS * OUTPUTS + 1)
    layer(x)
    assert chosen == made


def test_the_layer_is_pytorchs_to_rounding(chosen) -> None:
    torch.manual_seed(0)
    layer = Linear(INPUTS, OUTPUTS)
    own = torch.nn.Linear(INPUTS, OUTPUTS)
    own.load_state_dict(layer.state_dict())
    x = drawn(ROWS, INPUTS)
    assert_close(layer(x), own(x))


@pytest.mark.parametrize(("processor", "capability", "faster"), [
    ("vendor_id : AuthenticAMD", "AVX512", True),
    ("vendor_id : AuthenticAMD", "AVX2", False),
    ("vendor_id : GenuineIntel", "AVX512", False),
])  # fmt: skip
def test_it_is_chosen_on_amds_processors_alone(monkeypatch, processor, capability, faster) -> None:
    monkeypatch.setattr(products, "_processor", lambda: processor)
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    monkeypatch.setattr(torch.backends.mkl, "is_available", lambda: True)
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: True)
    monkeypatch.setattr(products, "_onednn", lambda x, weight, bias: torch.nn.functional.linear(x, weight, bias))
    assert products.is_faster_here.__wrapped__() is faster
    monkeypatch.setattr(products, "_onednn", lambda *_: torch.ops.mkldnn.no_such_operation(*_))
    assert products.is_faster_here.__wrapped__() is False

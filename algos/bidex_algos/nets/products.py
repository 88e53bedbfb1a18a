"""The products of layers with weights, by the faster of the two libraries that PyTorch computes them with on a CPU.

PyTorch takes MKL, which runs AMD's processors without their AVX-512: oneDNN, of the same precision, is more than twice
as fast there (docs/results/speed.md). ``torch.backends.mkldnn.flags(enabled=False)`` turns it off.
"""

import platform
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

_LEAST = 1 << 21  # multiplications from which oneDNN pays: below, what a call costs is more than what it saves


def affine(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """``x @ weight.T + bias``, differentiable: (..., inputs), (outputs, inputs), (outputs,) to (..., outputs)."""
    if not _pays(x, weight):
        if x.is_cuda and torch.is_autocast_enabled("cuda"):
            x, weight = _in_eights(x, weight)
        return nn.functional.linear(x, weight, bias)
    rows = x.reshape(-1, x.shape[-1])
    out = cast(Tensor, _Affine.apply(rows, weight, bias)) if torch.is_grad_enabled() else _onednn(rows, weight, bias)
    return out.view(*x.shape[:-1], -1)


def _in_eights(x: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Both with zero columns to a multiple of eight: else cuBLAS's bfloat16 product is a slow one of older GPUs.

    Of 422 columns the first layer took 51 of 106 ms of MT-PPO's products on an H200, with 18 % of the multiplications.
    """
    missing = -x.shape[-1] % 8
    return (nn.functional.pad(x, (0, missing)), nn.functional.pad(weight, (0, missing))) if missing else (x, weight)


def stacked_affine(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """Layers of one form with a batch each: (K, batch, in), (K, out, in), (K, out) to (K, batch, out)."""
    if _pays(x[0], weight[0]):
        biases = [None] * len(x) if bias is None else bias.unbind()
        return torch.stack([affine(*each) for each in zip(x.unbind(), weight.unbind(), biases, strict=True)])
    if bias is None:
        return torch.bmm(x, weight.transpose(1, 2))
    return torch.baddbmm(bias[:, None], x, weight.transpose(1, 2))


def by_own(x: Tensor, index: Tensor, layers: Sequence[Callable[[Tensor], Tensor]]) -> Tensor:
    """Each row (B, inputs) by the one of ``layers`` that int64 (B,) names: (B, outputs). Looks at numbers."""
    sizes = torch.bincount(index, minlength=len(layers)).tolist()
    in_order = bool((index[1:] >= index[:-1]).all())  # batches that are drawn task by task: nothing to move
    order = slice(None) if in_order else index.argsort(stable=True)
    parts = x[order].split(sizes)
    out = torch.cat([layer(part) for layer, part in zip(layers, parts, strict=True) if len(part)])
    return out if isinstance(order, slice) else out[order.argsort()]


def own_head(x: Tensor, weight: Tensor, bias: Tensor, index: Tensor, heads: int) -> Tensor:
    """Each row by a layer of its own: (B, inputs), (heads * n, inputs), (heads * n,), int64 (B,) to (B, n).

    Looks at numbers. With twenty heads of 52 actions it takes a twentieth of what all heads of all rows take.
    """
    layers = zip(weight.unflatten(0, (heads, -1)), bias.unflatten(0, (heads, -1)), strict=True)
    return by_own(x, index, [partial(affine, weight=each, bias=offset) for each, offset in layers])


class Linear(nn.Linear):
    """PyTorch's layer, computed by :func:`affine`."""

    def forward(self, input: Tensor) -> Tensor:
        """Maps (..., inputs) to (..., outputs)."""
        return affine(input, self.weight, self.bias)


class _Affine(torch.autograd.Function):
    """oneDNN's product, which knows no gradient; those are products too, so that there are gradients of them."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        return _onednn(x, weight, bias)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, Tensor | None], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:2])

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[Tensor | None, ...]:
        (grad,), (x, weight) = grads, ctx.saved_tensors
        of_x, of_weight, of_bias = ctx.needs_input_grad
        return (
            affine(grad, weight.t()) if of_x else None,
            affine(grad.t(), x.t()) if of_weight else None,
            grad.sum(0) if of_bias else None,
        )


def _onednn(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    return torch.ops.mkldnn._linear_pointwise(_dense(x), _dense(weight), bias, "none", [], "")


def _dense(x: Tensor) -> Tensor:
    """The same numbers without gaps, by rows or by columns: others oneDNN multiplies by its slowest code."""
    return x if x.is_contiguous() or x.t().is_contiguous() else x.contiguous()


def _pays(x: Tensor, weight: Tensor) -> bool:
    """Whether oneDNN is to make ``x @ weight.T``."""
    return (
        x.device.type == "cpu"
        and torch.backends.mkldnn.enabled  # before sizes, which an export leaves open
        and x.numel() * len(weight) >= _LEAST
        and x.dtype == weight.dtype == torch.float32
        and not torch.is_autocast_enabled("cpu")
        and is_faster_here()
    )


@cache
def is_faster_here() -> bool:
    """Whether this machine's processor is AMD's with AVX-512, and PyTorch has both libraries."""
    both = torch.backends.mkl.is_available() and torch.backends.mkldnn.is_available()
    if not both or torch.backends.cpu.get_cpu_capability() != "AVX512" or "AuthenticAMD" not in _processor():
        return False
    try:  # an operation that PyTorch keeps for its compiler: another version may call it otherwise
        return _onednn(torch.ones(2, 3), torch.ones(2, 3), None).shape == (2, 2)
    except (AttributeError, RuntimeError, TypeError):
        return False


def _processor() -> str:
    try:
        return Path("/proc/cpuinfo").read_text(errors="ignore")
    except OSError:
        return platform.processor()  # where it is no Linux

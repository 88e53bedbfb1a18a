"""Products of inputs with a layer's weights, by the faster of the two libraries that PyTorch uses on a CPU.

PyTorch prefers MKL, which does not use AVX-512 on AMD's processors. On these, oneDNN is more than twice as fast with
the same precision: MT-PPO learned for 0.57 instead of 0.90 s per iteration (one core, preset ``laptop``).
``torch.backends.mkldnn.flags(enabled=False)`` turns oneDNN off.
"""

import platform
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

_LEAST = 1 << 21  # least number of multiplications for oneDNN; with fewer, the call's overhead exceeds the gain


def affine(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """Return ``x @ weight.T + bias`` of shape (..., outputs), which is differentiable.

    The arguments are ``x`` (..., inputs), ``weight`` (outputs, inputs) and ``bias`` (outputs,).
    """
    if not _pays(x, weight):
        if x.is_cuda and torch.is_autocast_enabled("cuda"):
            x, weight = _in_eights(x, weight)
        return nn.functional.linear(x, weight, bias)
    rows = x.reshape(-1, x.shape[-1])
    if torch.is_grad_enabled():
        out = cast(Tensor, _Affine.apply(rows, weight, bias))
    else:
        out = _onednn(rows, weight, bias)
    return out.view(*x.shape[:-1], -1)


def _in_eights(x: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Pad inputs and weights with zero columns to a multiple of eight; otherwise cuBLAS chooses a slow bfloat16 kernel.

    With 422 columns the first layer took 51 of the 106 ms of MT-PPO's products on an H200, although it has only 18 % of
    the multiplications.
    """
    missing = -x.shape[-1] % 8
    if missing:
        return (nn.functional.pad(x, (0, missing)), nn.functional.pad(weight, (0, missing)))
    return (x, weight)


def stacked_affine(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """Apply K linear layers, each to its own batch, and return (K, batch, out).

    The arguments are ``x`` (K, batch, in), ``weight`` (K, out, in) and ``bias`` (K, out).
    """
    if _pays(x[0], weight[0]):
        if bias is None:
            biases = [None] * len(x)
        else:
            biases = bias.unbind()
        return torch.stack([affine(*each) for each in zip(x.unbind(), weight.unbind(), biases, strict=True)])
    if bias is None:
        return torch.bmm(x, weight.transpose(1, 2))
    return torch.baddbmm(bias[:, None], x, weight.transpose(1, 2))


def by_own(x: Tensor, index: Tensor, layers: Sequence[Callable[[Tensor], Tensor]]) -> Tensor:
    """Apply to each row of ``x`` (B, inputs) the layer ``layers[index]`` and return (B, outputs); needs a host sync.

    ``index``, int64 (B,), has one entry per row.
    """
    sizes = torch.bincount(index, minlength=len(layers)).tolist()
    in_order = bool((index[1:] >= index[:-1]).all())  # batches drawn task by task need no reordering
    if in_order:
        order = slice(None)
    else:
        order = index.argsort(stable=True)
    parts = x[order].split(sizes)
    out = torch.cat([layer(part) for layer, part in zip(layers, parts, strict=True) if len(part)])
    if isinstance(order, slice):
        return out
    return out[order.argsort()]


def own_head(x: Tensor, weight: Tensor, bias: Tensor, index: Tensor, heads: int) -> Tensor:
    """Apply to each row of ``x`` (B, inputs) the output layer of one head, and return (B, n).

    ``index``, int64 (B,), is the head of each row. ``weight`` (heads * n, inputs) and ``bias`` (heads * n,) hold the
    layers of all heads. The function needs a host sync. With twenty heads of 52 actions it takes a twentieth of the
    time of applying all heads to all rows.
    """
    layers = zip(weight.unflatten(0, (heads, -1)), bias.unflatten(0, (heads, -1)), strict=True)
    return by_own(x, index, [partial(affine, weight=each, bias=offset) for each, offset in layers])


class Linear(nn.Linear):
    """PyTorch's linear layer, computed by :func:`affine`."""

    def forward(self, input: Tensor) -> Tensor:
        """Map (..., inputs) to (..., outputs)."""
        return affine(input, self.weight, self.bias)


class _Affine(torch.autograd.Function):
    """oneDNN's linear layer with a gradient, because PyTorch's operation for oneDNN has none.

    The gradient consists of calls of :func:`affine`, so that it can be differentiated again.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        return _onednn(x, weight, bias)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, Tensor | None], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:2])

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> tuple[Tensor | None, ...]:
        (grad,) = grads
        x, weight = ctx.saved_tensors
        of_x, of_weight, of_bias = ctx.needs_input_grad
        grad_x = affine(grad, weight.t()) if of_x else None
        grad_weight = affine(grad.t(), x.t()) if of_weight else None
        grad_bias = grad.sum(0) if of_bias else None
        return grad_x, grad_weight, grad_bias


def _onednn(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    return torch.ops.mkldnn._linear_pointwise(_dense(x), _dense(weight), bias, "none", [], "")


def _dense(x: Tensor) -> Tensor:
    """Make the tensor contiguous by rows or by columns; oneDNN multiplies other layouts by its slowest code."""
    if x.is_contiguous() or x.t().is_contiguous():
        return x
    return x.contiguous()


def _pays(x: Tensor, weight: Tensor) -> bool:
    """Return whether oneDNN should compute ``x @ weight.T``."""
    return (
        x.device.type == "cpu"
        and torch.backends.mkldnn.enabled  # checked before sizes, which an export leaves open
        and x.numel() * len(weight) >= _LEAST
        and x.dtype == weight.dtype == torch.float32
        and not torch.is_autocast_enabled("cpu")
        and is_faster_here()
    )


@cache
def is_faster_here() -> bool:
    """Return whether oneDNN is faster than MKL on this machine.

    This holds on AMD processors with AVX-512. The result is False if PyTorch lacks one of the two libraries, or
    oneDNN's operation.
    """
    both = torch.backends.mkl.is_available() and torch.backends.mkldnn.is_available()
    if not both or torch.backends.cpu.get_cpu_capability() != "AVX512" or "AuthenticAMD" not in _processor():
        return False
    try:  # PyTorch keeps this operation for its compiler, and another version may name it differently
        return _onednn(torch.ones(2, 3), torch.ones(2, 3), None).shape == (2, 2)
    except (AttributeError, RuntimeError, TypeError):
        return False


def _processor() -> str:
    try:
        return Path("/proc/cpuinfo").read_text(errors="ignore")
    except OSError:
        return platform.processor()  # fallback for systems other than Linux

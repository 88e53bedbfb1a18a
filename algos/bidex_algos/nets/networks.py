"""Networks and the diagonal Gaussian that the learners share; knows no loss and no optimiser."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal

import torch
from msgspec import Meta
from torch import Tensor, nn

from bidex_algos.nets.inputs import GroupEncoder, Inputs
from bidex_algos.nets.products import Linear, affine, stacked_affine
from bidex_meta.utils.validation import Width

Activation = Literal["elu", "relu", "tanh"]
ACTIVATIONS: dict[str, type[nn.Module]] = {"elu": nn.ELU, "relu": nn.ReLU, "tanh": nn.Tanh}
Autocast = Literal["auto", "on", "off"]
"""Whether hidden layers run in bfloat16."""
Layers = Annotated[tuple[Width, ...], Meta(max_length=64)]
"""Widths of hidden layers; none makes a linear map."""


def use_bfloat16(setting: Autocast, device: torch.device) -> bool:
    """Whether to run hidden layers in bfloat16: "auto" means on a CUDA device or a CPU that multiplies it.

    CPUs with AMX tiles or AVX-512's BF16 do; on others such products are emulated and slower than float32.
    """
    if setting != "auto":
        return setting == "on"
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    # Functions of some of PyTorch's versions.
    supported = [vars(torch.cpu).get(f"_is_{name}_supported") for name in ("amx_tile", "avx512_bf16")]
    return device.type == "cpu" and any(check is not None and check() for check in supported)


def autocast(device: torch.device, enabled: bool) -> torch.autocast:
    """The autocast context for ``device``; does nothing unless ``enabled``."""
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=enabled)


class MLP(nn.Module):
    """Fully connected network with orthogonal weights and zero biases.

    The hidden layers follow an enclosing autocast; the output layer is always float32. It is a small part of the work,
    and a bfloat16 output would round a mean of 1 by 0.004: enough to move the likelihood ratio of 52 actions.

    Args:
        inputs: What it is fed: groups, some perhaps by encoders of their own; or a width.
        hidden: Widths of the hidden layers.
        outputs: Width of the output.
        output_gain: Gain of the orthogonal output layer (hidden layers: sqrt 2).
        generator: CPU generator of the initial weights; the global one is left alone.
        activation: Name of the non-linearity.
        layer_norm: Whether to normalise what goes into each non-linearity.
    """

    def __init__(
        self,
        inputs: int | Inputs,
        hidden: Sequence[int],
        outputs: int,
        output_gain: float,
        generator: torch.Generator,
        activation: Activation = "elu",
        layer_norm: bool = False,
    ):
        super().__init__()
        self.encoder = GroupEncoder(inputs, generator)
        layers: list[nn.Module] = []
        before = self.encoder.size
        for width in hidden:
            layers.append(linear(before, width, math.sqrt(2.0), generator))
            if layer_norm:
                layers.append(nn.LayerNorm(width))
            layers.append(ACTIVATIONS[activation]())
            before = width
        self.body = nn.Sequential(*layers)
        self.head = linear(before, outputs, output_gain, generator)

    @property
    def output_bias(self) -> Tensor:
        """Biases of the output (outputs,)."""
        return self.head.bias

    def forward(self, x: Tensor) -> Tensor:
        """Maps (batch, inputs) to float32 (batch, outputs)."""
        features = self.body(self.encoder(x))
        with torch.autocast(x.device.type, enabled=False):
            return self.head(features.to(self.head.weight.dtype))


def stacked_forward(network: MLP, params: Mapping[str, Tensor], prefix: str, x: Tensor, own: str = "") -> Tensor:
    """The outputs of M networks of one form on a batch each: (M, B, inputs) to (M, B, outputs).

    Encoders of groups are ``network``'s own, the same for all tasks. The rest is the same as ``vmap`` of
    ``functional_call``, and 1.5 to 1.8 times as fast for 40 tasks of 20 environments on one core.

    Args:
        network: Gives the form.
        params: Stacked parameters, (M, ...) each, by their names in an enclosing module.
        prefix: What these names begin with.
        x: Inputs.
        own: What the names of those begin with that differ between the networks; of others the first serves all.
    """

    def stacked(name: str, x: Tensor) -> Tensor:
        weight, bias = params[f"{prefix}{name}.weight"], params[f"{prefix}{name}.bias"]
        if not f"{prefix}{name}.".startswith(own):
            return affine(x, weight[0], bias[0])
        return stacked_affine(x, weight, bias)

    x = network.encoder(x)
    for name, layer in network.body.named_children():
        if isinstance(layer, nn.LayerNorm):
            raise TypeError("stacked_forward knows no layer norm")
        x = stacked(f"body.{name}", x) if isinstance(layer, nn.Linear) else layer(x)
    with torch.autocast(x.device.type, enabled=False):
        return stacked("head", x.to(params[f"{prefix}head.weight"].dtype))


def linear(inputs: int, outputs: int, gain: float, generator: torch.Generator) -> nn.Linear:
    """A layer with orthogonal weights of this gain, drawn from a CPU generator, and zero biases."""
    # Made without memory first: the default initialisation would draw from (and so disturb) the global generator.
    layer = Linear(inputs, outputs, device="meta").to_empty(device=torch.get_default_device())
    nn.init.orthogonal_(layer.weight, gain, generator=generator)
    nn.init.zeros_(layer.bias)
    return layer


class GaussianActor(nn.Module):
    """Diagonal Gaussian: the mean from a network, a standard deviation per action that knows no state.

    Args:
        inputs: The groups of the (normalised) observation, or its width.
        hidden: Widths of the hidden layers.
        actions: Number of actions.
        init_std: Standard deviation at the start.
        generator: CPU generator of the initial weights.
        activation: Name of the non-linearity.
        heads: Output layers and rows of standard deviations; more than one: as many as the group ``task_id`` has
            columns, which choose the head.
        network: What makes the network of the mean, by the arguments of :class:`MLP`.

    Attributes:
        log_std: Logarithms of the standard deviations, (actions,); with more than one head (heads, actions).
    """

    def __init__(
        self,
        inputs: int | Inputs,
        hidden: Sequence[int],
        actions: int,
        init_std: float,
        generator: torch.Generator,
        activation: Activation = "elu",
        heads: int = 1,
        network: Callable[..., Any] = MLP,
    ):
        super().__init__()
        self.heads = heads
        self.one_hot = Inputs.of(inputs).columns(*["task_id"] * (heads > 1))
        self.mean = network(inputs, hidden, heads * actions, 0.01, generator, activation)
        shape = (actions,) if heads == 1 else (heads, actions)
        self.log_std = nn.Parameter(torch.full(shape, math.log(init_std)))

    def forward(self, x: Tensor) -> Tensor:
        """Mean action of normalised observations (batch, observations), float32 (batch, actions), not clamped."""
        out = self.mean(x)
        if self.heads == 1:
            return out
        heads = out.unflatten(-1, (self.heads, -1))
        with torch.autocast(x.device.type, enabled=False):  # like the output layer: means would be rounded
            return torch.einsum("...h,...ha->...a", self.one_hot(x).to(out.dtype), heads)

    def log_std_of(self, x: Tensor, log_std: Tensor | None = None) -> Tensor:
        """The rows of ``log_std`` (default: the present ones) that hold for observations (batch, observations).

        Returns:
            (actions,) with one head, else (batch, actions).
        """
        log_std = self.log_std if log_std is None else log_std
        if self.heads == 1:
            return log_std
        with torch.autocast(x.device.type, enabled=False):
            return self.one_hot(x).to(log_std.dtype) @ log_std


def gaussian_log_prob(action: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Log-density of N(mean, exp(log_std)^2), summed over the last axis. Shape (...)."""
    z = (action - mean) * torch.exp(-log_std)
    return -0.5 * z.square().sum(-1) - (log_std + 0.5 * math.log(2.0 * math.pi)).expand(mean.shape).sum(-1)


def gaussian_kl(mean_p: Tensor, log_std_p: Tensor, mean_q: Tensor, log_std_q: Tensor) -> Tensor:
    """KL(p || q) of two diagonal Gaussians, summed over the last axis. Shape (...)."""
    variance_ratio = torch.exp(2.0 * (log_std_p - log_std_q))
    shift = ((mean_p - mean_q) * torch.exp(-log_std_q)).square()
    return (log_std_q - log_std_p + 0.5 * (variance_ratio + shift - 1.0)).sum(-1)


def gaussian_entropy(log_std: Tensor) -> Tensor:
    """Differential entropy of a diagonal Gaussian, summed over the last axis. Shape (...)."""
    return (log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum(-1)

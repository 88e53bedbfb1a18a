"""Architectures that replace an ``MLP``.

In MOORE, PaCo, soft modules and towers, each task uses its own weights, modules or mixture of them. The transformer
attends to groups of the observation.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial, reduce
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from bidex_algos.nets.inputs import GroupEncoder, Inputs
from bidex_algos.nets.networks import ACTIVATIONS, Activation, Headed, linear
from bidex_algos.nets.products import affine, by_own, stacked_affine
from bidex_meta.utils import maths


class StackedLinear(nn.Module):
    """``count`` (K) parallel linear layers of the same size, with orthogonal weights (``gain``) and zero biases."""

    def __init__(
        self, count: int, inputs: int, outputs: int, gain: float, generator: torch.Generator, bias: bool = True
    ):
        super().__init__()
        self.weight = nn.Parameter(torch.empty(count, outputs, inputs))
        if bias:
            self.bias = nn.Parameter(torch.zeros(count, outputs))
        else:
            self.bias = None
        for layer in self.weight.detach():
            nn.init.orthogonal_(layer, gain, generator=generator)

    def each(self) -> list[Callable[[Tensor], Tensor]]:
        """Return each layer as a function that maps (batch, inputs) to (batch, outputs)."""
        if self.bias is None:
            biases = [None] * len(self.weight)
        else:
            biases = self.bias.unbind()
        return [partial(affine, weight=w, bias=b) for w, b in zip(self.weight.unbind(), biases, strict=True)]

    def forward(self, x: Tensor) -> Tensor:
        """Map (batch, inputs), shared by all layers, or (K, batch, inputs), one per layer, to (K, batch, outputs)."""
        if x.dim() == 2:
            if self.bias is None:
                bias = None
            else:
                bias = self.bias.flatten()
            out = affine(x, self.weight.flatten(0, 1), bias)
            return out.unflatten(-1, self.weight.shape[:2]).transpose(0, 1)
        return stacked_affine(x, self.weight, self.bias)


class TaskWeights(nn.Module):
    """``count`` (K) mixture weights for each task, selected by the task's one-hot.

    Initially the weights of a task are a random vector of unit norm, so that a mixture is as large as its parts.
    """

    def __init__(self, inputs: Inputs, count: int, generator: torch.Generator):
        super().__init__()
        self.one_hot = inputs.columns("task_id")
        drawn = torch.randn(self.one_hot.size, count, generator=generator)
        self.rows = nn.Parameter(drawn / drawn.norm(dim=1, keepdim=True))

    def forward(self, x: Tensor) -> Tensor:
        """Return the weights (batch, K), float32, for the tasks in observations (batch, d)."""
        with torch.autocast(x.device.type, enabled=False):  # a bfloat16 weight would round means by 0.4 %
            return self.one_hot(x).to(self.rows.dtype) @ self.rows


def mixed(weights: Tensor, parts: Tensor) -> Tensor:
    """Sum parts (K, batch, n) with the weights (batch, K) of each environment: (batch, n)."""
    return torch.einsum("bk,kbn->bn", weights, parts)


class PlainNorm(nn.Module):
    """Layer normalisation without weights, so that it can follow stacked layers; the identity if not ``enabled``."""

    def __init__(self, enabled: bool):
        super().__init__()
        self.enabled = enabled

    def forward(self, x: Tensor) -> Tensor:
        """Normalise the last axis."""
        if self.enabled:
            return nn.functional.layer_norm(x, x.shape[-1:])
        return x


def gram_schmidt(vectors: Tensor) -> Tensor:
    """Make vectors (K, batch, n) orthonormal, separately for each entry of the batch; the first keeps its direction.

    The projections on the previous vectors are removed twice, because the first pass leaves large rounding errors if
    two vectors are almost parallel.
    """
    found: list[Tensor] = []
    for vector in vectors:
        for other in found * 2:
            vector = vector - (vector * other).sum(-1, keepdim=True) * other
        found.append(vector * (vector.square().sum(-1, keepdim=True) + 1e-20).rsqrt())
    return torch.stack(found)


class Moore(Headed):
    """MOORE: a mixture of orthogonal experts (Hendawy et al. 2024).

    The output is y = head(V w_k). The columns of V are K experts' representations of a state, made orthonormal by
    Gram-Schmidt; w_k are the weights of the experts in task k. The task's one-hot selects w_k and is not fed to the
    experts. Heads per task are the paper's multi-head variant.

    We made three additions. The mixture is multiplied by the root of its width, so that its entries are as large as
    those of a usual hidden layer. The mixture then passes through the config's non-linearity. Each w_k is initially a
    random vector of unit norm.
    """

    def __init__(
        self, inputs: int | Inputs, hidden: Sequence[int], outputs: int, output_gain: float, generator: torch.Generator,
        activation: Activation = "elu", layer_norm: bool = False, *, modules: int
    ):  # fmt: skip
        super().__init__()
        inputs = Inputs.of(inputs)
        self.encoder = GroupEncoder(inputs.without("task_id"), generator)
        self.weights = TaskWeights(inputs, modules, generator)
        layers: list[nn.Module] = []
        for before, width in pairwise([self.encoder.size, *hidden]):
            layers += [StackedLinear(modules, before, width, math.sqrt(2.0), generator)]
            layers += [PlainNorm(layer_norm), ACTIVATIONS[activation]()]
        self.body = nn.Sequential(*layers[:-2])  # vectors are orthogonalised before the non-linearity
        self.activation = ACTIVATIONS[activation]()
        self.scale = math.sqrt(hidden[-1])
        self.head = linear(hidden[-1], outputs, output_gain, generator)

    def experts(self, x: Tensor) -> Tensor:
        """Return orthonormal representations (K, batch, width), float32, of observations (batch, inputs)."""
        raw = self.body(self.encoder(x))
        with torch.autocast(x.device.type, enabled=False):
            return gram_schmidt(raw.to(self.head.weight.dtype))

    def features(self, x: Tensor) -> Tensor:
        """Return the input (batch, width) of the output layer for network inputs (batch, inputs), in float32."""
        experts = self.experts(x)
        with torch.autocast(x.device.type, enabled=False):
            return self.activation(self.scale * mixed(self.weights(x), experts))


class PaCo(nn.Module):
    """PaCo: a task's parameters are a mixture of a few parameter sets, theta_k = Phi w_k (Sun et al. 2022).

    A layer is linear in its parameters, so the composed layer's output is the mixture of the K layers' outputs; the
    non-linearity follows. The task's one-hot selects w_k and is not fed to the layers.

    Our changes: actor and each critic have their own w, which is initially a random vector of unit norm. Biases of the
    output are not composed, because the actor's biases hold its initial standard deviation. We omit the paper's masking
    and restart of tasks whose loss explodes.
    """

    def __init__(
        self, inputs: int | Inputs, hidden: Sequence[int], outputs: int, output_gain: float, generator: torch.Generator,
        activation: Activation = "elu", layer_norm: bool = False, *, modules: int
    ):  # fmt: skip
        super().__init__()
        inputs = Inputs.of(inputs)
        self.encoder = GroupEncoder(inputs.without("task_id"), generator)
        self.weights = TaskWeights(inputs, modules, generator)
        widths = [self.encoder.size, *hidden]
        self.layers = nn.ModuleList()
        for size, width in pairwise(widths):
            self.layers.append(StackedLinear(modules, size, width, math.sqrt(2.0), generator))
        self.between = nn.Sequential(PlainNorm(layer_norm), ACTIVATIONS[activation]())
        self.head = StackedLinear(modules, widths[-1], outputs, output_gain, generator, bias=False)
        self.output_bias = nn.Parameter(torch.zeros(outputs))

    def forward(self, x: Tensor) -> Tensor:
        """Map (batch, inputs) to float32 (batch, outputs)."""
        weights = self.weights(x)
        features = self.encoder(x)
        for layer in self.layers:
            features = self.between(mixed(weights, layer(features)))
        with torch.autocast(x.device.type, enabled=False):
            return mixed(weights, self.head(features.to(weights.dtype))) + self.output_bias


class SoftModules(Headed):
    """Soft modularisation: layers of modules, with soft routes between them for each task (Yang et al. 2020).

    Let f(s) and h(k) be embeddings of state s and task k, and e their elementwise product. The logits of the routes are
    p^1 = D^1 relu(e) and p^(l+1) = D^(l+1) relu((U^l p^l) * e), where * is the elementwise product. The input of module
    i is g_i = sum_j softmax_j(p_ij) relu(W_j g_j). The first entry of ``hidden`` is the width of f(s); each further
    entry is the width of a layer of modules.

    Three things differ from the paper. The head reads a weighted sum of the modules of the last layer, while the paper
    adds them up. f is one layer. Modules have the config's non-linearity. We omit the weighting of losses by
    temperature.
    """

    def __init__(
        self, inputs: int | Inputs, hidden: Sequence[int], outputs: int, output_gain: float, generator: torch.Generator,
        activation: Activation = "elu", layer_norm: bool = False, *, modules: int
    ):  # fmt: skip
        super().__init__()
        inputs = Inputs.of(inputs)
        gain = math.sqrt(2.0)
        embedding = hidden[0]
        self.modules_of_layer = modules
        self.one_hot = inputs.columns("task_id")
        self.encoder = GroupEncoder(inputs.without("task_id"), generator)
        self.between = nn.Sequential(PlainNorm(layer_norm), ACTIVATIONS[activation]())
        self.state = linear(self.encoder.size, embedding, gain, generator)
        self.task = linear(self.one_hot.size, embedding, gain, generator)
        self.layers = nn.ModuleList(StackedLinear(modules, a, b, gain, generator) for a, b in pairwise(hidden))
        routes = [modules**2] * (len(hidden) - 2) + [modules]
        self.down = nn.ModuleList(linear(embedding, size, 1.0, generator) for size in routes)
        self.up = nn.ModuleList(linear(size, embedding, gain, generator) for size in routes[:-1])
        self.head = linear(hidden[-1], outputs, output_gain, generator)

    def routes(self, x: Tensor, state: Tensor) -> list[Tensor]:
        """Return the weights of the routes from each layer, (batch, receiving modules, sending modules).

        The weights of a receiving module sum to 1. ``state`` (batch, width) is the embedding of x.
        """
        both = state * self.task(self.one_hot(x).to(state.dtype))
        logits = self.down[0](both.relu())
        found = [logits]
        for up, down in zip(self.up, self.down[1:], strict=True):
            logits = down((up(logits) * both).relu())
            found.append(logits)
        return [each.unflatten(1, (-1, self.modules_of_layer)).softmax(-1) for each in found]

    def embedded(self, x: Tensor) -> Tensor:
        """Return embeddings (batch, width) of the states in observations (batch, inputs)."""
        return self.between(self.state(self.encoder(x)))

    def features(self, x: Tensor) -> Tensor:
        """Return the input (batch, width) of the output layer for network inputs (batch, inputs)."""
        features = state = self.embedded(x)
        for layer, shares in zip(self.layers, self.routes(x, state), strict=True):
            features = torch.einsum("bij,jbn->ibn", shares, self.between(layer(features)))
        return features[0]


class Towers(Headed):
    """A network whose first ``shared`` layers belong to all tasks; each task has its own further layers.

    If ``shared`` is 0, each task has its own network. The task's one-hot selects the layers and is not fed to them.
    """

    def __init__(
        self, inputs: int | Inputs, hidden: Sequence[int], outputs: int, output_gain: float, generator: torch.Generator,
        activation: Activation = "elu", layer_norm: bool = False, *, modules: int, shared: int
    ):  # fmt: skip
        super().__init__()
        inputs = Inputs.of(inputs)
        gain = math.sqrt(2.0)
        self.one_hot = inputs.columns("task_id")
        self.encoder = GroupEncoder(inputs.without("task_id"), generator)
        widths = list(pairwise([self.encoder.size, *hidden]))
        self.between = nn.Sequential(PlainNorm(layer_norm), ACTIVATIONS[activation]())
        self.common = nn.ModuleList(linear(*pair, gain, generator) for pair in widths[:shared])
        own = [StackedLinear(self.one_hot.size, *pair, gain, generator) for pair in widths[shared:]]
        self.own: Sequence[StackedLinear] = nn.ModuleList(own)  # type: ignore[assignment]
        self.head = linear([self.encoder.size, *hidden][-1], outputs, output_gain, generator)

    def features(self, x: Tensor) -> Tensor:
        """Return the input (batch, width) of the output layer for network inputs (batch, inputs)."""
        one_hot = self.one_hot(x)
        features = self.encoder(x)
        for layer in self.common:
            features = self.between(layer(features))
        if not self.own:  # tasks differ only in the output layer
            return features
        if maths.may_look(x.device):
            parts = zip(*(layer.each() for layer in self.own), strict=True)
            return by_own(features, one_hot.argmax(-1), [self._tower(layers) for layers in parts])
        for layer in self.own:
            features = self.between(layer(features))
        return mixed(one_hot, features)

    def _tower(self, layers: Sequence[Callable[[Tensor], Tensor]]) -> Callable[[Tensor], Tensor]:
        return lambda x: reduce(lambda x, layer: self.between(layer(x)), layers, x)


class Transformer(Headed):
    """One token per group of the observation; every token attends to all (Vaswani et al. 2017, arXiv 1706.03762).

    Each entry of ``hidden`` adds a block with ``modules`` attention heads; all entries must be the same width. Tokens
    are normalised before each half of a block (Xiong et al. 2020, arXiv 2002.04745), independent of ``layer_norm``. The
    output layer reads the mean of the tokens.
    """

    def __init__(
        self, inputs: int | Inputs, hidden: Sequence[int], outputs: int, output_gain: float, generator: torch.Generator,
        activation: Activation = "elu", layer_norm: bool = False, *, modules: int
    ):  # fmt: skip
        super().__init__()
        inputs = Inputs.of(inputs)
        width = hidden[-1]
        shown = [group.name for group in inputs.groups if group.name not in inputs.hidden]
        encoders = [GroupEncoder(inputs.only(name), generator) for name in shown]
        self.encoders = nn.ModuleList(encoders)
        self.tokens = nn.ModuleList(linear(part.size, width, 1.0, generator) for part in encoders)
        with torch.random.fork_rng(devices=[]):  # PyTorch's layers draw from the global generator
            torch.manual_seed(int(torch.randint(2**62, (), generator=generator, device="cpu")))
            self.blocks = nn.Sequential()
            for _ in hidden:
                between = ACTIVATIONS[activation]()
                self.blocks.append(
                    nn.TransformerEncoderLayer(
                        width, modules, 2 * width, 0.0, between, batch_first=True, norm_first=True
                    )
                )
        self.norm = nn.LayerNorm(width)
        self.head = linear(width, outputs, output_gain, generator)

    def features(self, x: Tensor) -> Tensor:
        """Return the input (batch, width) of the output layer for network inputs (batch, inputs)."""
        tokens = [token(encoder(x)) for encoder, token in zip(self.encoders, self.tokens, strict=True)]
        with sdpa_kernel(SDPBackend.MATH):  # the other kernels have no second derivative, which TRPO needs
            return self.norm(self.blocks(torch.stack(tokens, dim=1)).mean(1))

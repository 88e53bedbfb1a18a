"""Soft modularisation: layers of modules, and for each task soft routes between them (Yang et al. 2020).

    e     = f(s) * h(k)                          embeddings of state and task, entry by entry
    p^1   = D^1 relu(e)                          logits of the routes from the first layer to the second
    p^l+1 = D^l+1 relu(U^l p^l * e)              each further layer of routes knows the one before
    g_i   = sum_j softmax_j(p_ij) relu(W_j g_j)  module i takes its shares of the modules before it

The first of ``hidden`` is the width of f(s), which feeds the first layer; each further one is that of a layer of
``modules`` modules. The task's one-hot enters by h alone.

Ours: the head takes shares of the last layer, where the paper adds its modules up, so that a single layer is routed
too; f is one layer; modules have the config's non-linearity. The paper's loss weights by temperature are left out.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from bidex_algos.choices import Activation
from bidex_algos.nets.encoders.inputs import GroupEncoder, Inputs
from bidex_algos.nets.multitask.parts import PlainNorm, StackedLinear
from bidex_algos.nets.networks import ACTIVATIONS, linear


class SoftModules(nn.Module):
    """Takes the place of :class:`~bidex_algos.nets.networks.MLP` and its arguments, and ``modules``: of a layer."""

    def __init__(
        self,
        inputs: int | Inputs,
        hidden: Sequence[int],
        outputs: int,
        output_gain: float,
        generator: torch.Generator,
        activation: Activation = "elu",
        layer_norm: bool = False,
        *,
        modules: int,
    ):
        super().__init__()
        inputs, gain, embedding = Inputs.of(inputs), math.sqrt(2.0), hidden[0]
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

    @property
    def output_bias(self) -> Tensor:
        """Biases of the output (outputs,)."""
        return self.head.bias

    def routes(self, x: Tensor, state: Tensor) -> list[Tensor]:
        """Shares (batch, modules that take, modules that give) between one layer and the next; they sum to 1.

        Args:
            x: Observations (batch, inputs).
            state: Their embeddings (batch, width).
        """
        both = state * self.task(self.one_hot(x).to(state.dtype))
        logits = self.down[0](both.relu())
        found = [logits]
        for up, down in zip(self.up, self.down[1:], strict=True):
            logits = down((up(logits) * both).relu())
            found.append(logits)
        return [each.unflatten(1, (-1, self.modules_of_layer)).softmax(-1) for each in found]

    def embedded(self, x: Tensor) -> Tensor:
        """Embeddings of the states of observations (batch, inputs): (batch, width)."""
        return self.between(self.state(self.encoder(x)))

    def forward(self, x: Tensor) -> Tensor:
        """Maps (batch, inputs) to float32 (batch, outputs)."""
        features = state = self.embedded(x)
        for layer, shares in zip(self.layers, self.routes(x, state), strict=True):
            features = torch.einsum("bij,jbn->ibn", shares, self.between(layer(features)))
        with torch.autocast(x.device.type, enabled=False):
            return self.head(features[0].to(self.head.weight.dtype))

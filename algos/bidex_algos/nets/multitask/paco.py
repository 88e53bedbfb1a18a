"""PaCo: the parameters of a task's network are a mixture of a few parameter sets (Sun et al. 2022).

    theta_k = Phi w_k        Phi: K parameter sets, shared by all tasks; w_k: K numbers of task k

Every task moves the sets, and of the numbers its own alone; what tasks have in common can lie in one set that many of
them weigh. A layer is linear in its parameters, so that the composed layer's output is the mixture of the K layers'
outputs: that is how it is computed, at the cost of K layers, and the non-linearity comes after. The task's one-hot
chooses w_k and is not fed to the layers.

Ours: actor and each critic have their own w; w starts as a random direction of length 1; the biases of the output are
not composed, since the actor's hold the standard deviation that it begins with; layer normalisation has no weights. Of
the paper's training, the masking and fresh start of tasks whose loss explodes is left out.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from bidex_algos.choices import Activation
from bidex_algos.nets.encoders.inputs import GroupEncoder, Inputs
from bidex_algos.nets.multitask.parts import PlainNorm, StackedLinear, TaskWeights, mixed
from bidex_algos.nets.networks import ACTIVATIONS


class PaCo(nn.Module):
    """Takes the place of :class:`~bidex_algos.nets.networks.MLP` and its arguments, and ``modules``: the sets."""

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
        inputs = Inputs.of(inputs)
        self.encoder = GroupEncoder(inputs.without("task_id"), generator)
        self.weights = TaskWeights(inputs, modules, generator)
        widths = [self.encoder.size, *hidden]
        self.layers = nn.ModuleList(
            StackedLinear(modules, a, b, math.sqrt(2.0), generator) for a, b in pairwise(widths)
        )
        self.between = nn.Sequential(PlainNorm(layer_norm), ACTIVATIONS[activation]())
        self.head = StackedLinear(modules, widths[-1], outputs, output_gain, generator, bias=False)
        self.output_bias = nn.Parameter(torch.zeros(outputs))

    def forward(self, x: Tensor) -> Tensor:
        """Maps (batch, inputs) to float32 (batch, outputs)."""
        weights, features = self.weights(x), self.encoder(x)
        for layer in self.layers:
            features = self.between(mixed(weights, layer(features)))
        with torch.autocast(x.device.type, enabled=False):
            return mixed(weights, self.head(features.to(weights.dtype))) + self.output_bias

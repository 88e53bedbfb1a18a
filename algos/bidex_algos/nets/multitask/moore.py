"""MOORE: a mixture of orthogonal experts (Hendawy et al. 2024).

    U = [h_1(s), ..., h_K(s)]        K experts' representations of a state
    V = Gram-Schmidt(U)              the same made orthonormal, state by state
    v = V w_k                        what task k takes of each
    y = head(v)

Orthogonal, no two experts can say the same of a state, so that K of them span K directions. The task's one-hot
chooses w_k and is not fed to the experts. Heads of tasks (``policy_heads``, ``value_heads``) are the paper's multi-head
variant.

Ours: the mixture is multiplied by the root of its width, so that its entries are as large as those of another layer,
and goes through the non-linearity of the config; w starts as a random direction of length 1.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from bidex_algos.choices import Activation
from bidex_algos.nets.encoders.inputs import GroupEncoder, Inputs
from bidex_algos.nets.multitask.parts import PlainNorm, StackedLinear, TaskWeights, mixed
from bidex_algos.nets.networks import ACTIVATIONS, linear


def gram_schmidt(vectors: Tensor) -> Tensor:
    """Makes vectors (K, batch, n) orthonormal, each row of the batch for itself; the first keeps its direction.

    Each is freed of those before it twice: where two are almost parallel the first time leaves rounding errors that are
    large beside what remains.
    """
    found: list[Tensor] = []
    for vector in vectors:
        for other in found * 2:
            vector = vector - (vector * other).sum(-1, keepdim=True) * other
        found.append(vector * (vector.square().sum(-1, keepdim=True) + 1e-20).rsqrt())
    return torch.stack(found)


class Moore(nn.Module):
    """Takes the place of :class:`~bidex_algos.nets.networks.MLP` and its arguments, and ``modules``: experts."""

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
        layers: list[nn.Module] = []
        for before, width in pairwise([self.encoder.size, *hidden]):
            layers += [StackedLinear(modules, before, width, math.sqrt(2.0), generator)]
            layers += [PlainNorm(layer_norm), ACTIVATIONS[activation]()]
        self.body = nn.Sequential(*layers[:-2])  # what is made orthogonal has not been through a non-linearity
        self.activation, self.scale = ACTIVATIONS[activation](), math.sqrt(hidden[-1])
        self.head = linear(hidden[-1], outputs, output_gain, generator)

    @property
    def output_bias(self) -> Tensor:
        """Biases of the output (outputs,)."""
        return self.head.bias

    def experts(self, x: Tensor) -> Tensor:
        """Orthonormal representations (K, batch, width), float32, of observations (batch, inputs)."""
        raw = self.body(self.encoder(x))
        with torch.autocast(x.device.type, enabled=False):
            return gram_schmidt(raw.to(self.head.weight.dtype))

    def forward(self, x: Tensor) -> Tensor:
        """Maps (batch, inputs) to float32 (batch, outputs)."""
        experts = self.experts(x)
        with torch.autocast(x.device.type, enabled=False):
            return self.head(self.activation(self.scale * mixed(self.weights(x), experts)))

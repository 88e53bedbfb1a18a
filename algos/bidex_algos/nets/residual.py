"""Residual blocks with layer norm, wide and still stable (BroNet, Nauman et al. 2024, arXiv 2405.16158)."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from bidex_algos.choices import Activation
from bidex_algos.nets.encoders.inputs import Inputs
from bidex_algos.nets.networks import ACTIVATIONS, MLP, linear


class ResidualBlock(nn.Module):
    """x plus two normalised layers of it, with the non-linearity between them; sizes stay as they are.

    Args:
        width: Of x.
        generator: CPU generator of the initial weights.
        activation: Name of the non-linearity.
    """

    def __init__(self, width: int, generator: torch.Generator, activation: Activation):
        super().__init__()
        self.layers = nn.Sequential(
            linear(width, width, math.sqrt(2.0), generator),
            nn.LayerNorm(width),
            ACTIVATIONS[activation](),
            linear(width, width, math.sqrt(2.0), generator),
            nn.LayerNorm(width),
        )

    def forward(self, x: Tensor) -> Tensor:
        """Maps (batch, width) to (batch, width)."""
        return x + self.layers(x)


class ResidualMLP(MLP):
    """One normalised layer, then residual blocks: stands in the place of :class:`MLP`, whose arguments it takes.

    ``hidden`` is the width as often as there are blocks, and once more for the first layer. The layer norm is part of
    it: ``layer_norm`` changes nothing.
    """

    def __init__(
        self,
        inputs: int | Inputs,
        hidden: Sequence[int],
        outputs: int,
        output_gain: float,
        generator: torch.Generator,
        activation: Activation = "elu",
        layer_norm: bool = True,
    ):
        super().__init__(inputs, hidden[:1], outputs, output_gain, generator, activation, layer_norm=True)
        self.body.extend(ResidualBlock(width, generator, activation) for width in hidden[1:])

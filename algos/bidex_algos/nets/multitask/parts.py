"""What the multi-task networks are made of: several layers side by side, and weights that a task chooses."""

import torch
from torch import Tensor, nn

from bidex_algos.nets.encoders.inputs import Inputs
from bidex_algos.nets.products import affine, stacked_affine


class StackedLinear(nn.Module):
    """``count`` linear layers of one form side by side, orthogonal weights and zero biases.

    Args:
        count: How many, K.
        inputs: Width of what goes in.
        outputs: Width of what comes out.
        gain: Gain of the orthogonal weights.
        generator: CPU generator of the initial weights.
        bias: Whether each has biases.
    """

    def __init__(
        self, count: int, inputs: int, outputs: int, gain: float, generator: torch.Generator, bias: bool = True
    ):
        super().__init__()
        self.weight = nn.Parameter(torch.empty(count, outputs, inputs))
        self.bias = nn.Parameter(torch.zeros(count, outputs)) if bias else None
        for layer in self.weight.detach():
            nn.init.orthogonal_(layer, gain, generator=generator)

    def forward(self, x: Tensor) -> Tensor:
        """Maps (batch, inputs), the same for all, or (K, batch, inputs), one for each, to (K, batch, outputs)."""
        if x.dim() == 2:
            bias = None if self.bias is None else self.bias.flatten()
            out = affine(x, self.weight.flatten(0, 1), bias)
            return out.unflatten(-1, self.weight.shape[:2]).transpose(0, 1)
        return stacked_affine(x, self.weight, self.bias)


class TaskWeights(nn.Module):
    """Some numbers for each task, chosen by the one-hot in the group ``task_id``; drawn as directions of length 1.

    Of that length, since what they mix keeps its size then: the mixed parts are independent at first.

    Args:
        inputs: The groups of the observation.
        count: Numbers of a task, K.
        generator: CPU generator of the initial numbers.
    """

    def __init__(self, inputs: Inputs, count: int, generator: torch.Generator):
        super().__init__()
        self.one_hot = inputs.columns("task_id")
        drawn = torch.randn(self.one_hot.size, count, generator=generator)
        self.rows = nn.Parameter(drawn / drawn.norm(dim=1, keepdim=True))

    def forward(self, x: Tensor) -> Tensor:
        """The numbers (batch, K), float32, of the tasks of observations (batch, d)."""
        with torch.autocast(x.device.type, enabled=False):  # a bfloat16 weight would round means by 0.4 %
            return self.one_hot(x).to(self.rows.dtype) @ self.rows


def mixed(weights: Tensor, parts: Tensor) -> Tensor:
    """Sums of parts (K, batch, n) with the weights (batch, K) of each row: (batch, n)."""
    return torch.einsum("bk,kbn->bn", weights, parts)


class PlainNorm(nn.Module):
    """Layer normalisation without weights of its own, so that it may stand behind stacked layers; or nothing."""

    def __init__(self, enabled: bool):
        super().__init__()
        self.enabled = enabled

    def forward(self, x: Tensor) -> Tensor:
        """Normalises the last axis."""
        return nn.functional.layer_norm(x, x.shape[-1:]) if self.enabled else x

"""Sizes of the inner steps that are learned with the meta-parameters.

    theta' = theta - alpha * gradient        alpha: a number for each tensor (MAML++, Antoniou et al. 2019),
                                             or for each weight (Meta-SGD, Li et al. 2017)

The outer loop differentiates alpha like theta. Ours: alpha is a factor of ``inner_learning_rate`` that begins with 1
and stays at or above 0, so that one step size of Adam serves whatever the inner step began with.
"""

import torch
from torch import Tensor, nn

from bidex_algos.choices import StepSizeKind


class StepSizes(nn.Module):
    """A factor of the inner step for each tensor, or each weight, that it moves.

    Args:
        actor: Whose parameters are moved.
        moved: Their names.
        kind: ``layer``: a number for each tensor; ``weight``: one for each of its entries.
    """

    def __init__(self, actor: nn.Module, moved: list[str], kind: StepSizeKind):
        super().__init__()
        sizes = {name: p.shape if kind == "weight" else () for name, p in actor.named_parameters() if name in moved}
        self.factors = nn.ParameterDict({_key(name): torch.ones(size) for name, size in sizes.items()})

    def __getitem__(self, name: str) -> Tensor:
        """Factor of a parameter: a scalar, or of the parameter's shape."""
        return self.factors[_key(name)]

    @torch.no_grad()
    def project(self) -> None:
        """Moves factors below 0 back to it: a step uphill would unlearn."""
        for factor in self.parameters():
            factor.clamp_(min=0.0)

    @torch.no_grad()
    def mean(self) -> Tensor:
        """Mean factor over tensors and their entries, a scalar."""
        return torch.cat([factor.flatten() for factor in self.parameters()]).mean()


def _key(name: str) -> str:
    """Names of parameters must not hold dots."""
    return name.replace(".", "/")

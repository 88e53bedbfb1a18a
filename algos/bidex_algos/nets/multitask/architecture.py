"""The networks by the names that configs use."""

from collections.abc import Callable
from functools import partial
from typing import Any

from torch import Tensor, nn

from bidex_algos.nets.multitask.config import ArchitectureConfig
from bidex_algos.nets.multitask.moore import Moore
from bidex_algos.nets.multitask.paco import PaCo
from bidex_algos.nets.multitask.soft_modules import SoftModules
from bidex_algos.nets.networks import MLP

MakeNetwork = Callable[..., Any]
"""Takes ``MLP``'s arguments and gives a module with its ``forward`` and ``output_bias``."""

_TRUNKS: dict[str, type[nn.Module]] = {"soft_modules": SoftModules, "paco": PaCo, "moore": Moore}


def network_of(config: ArchitectureConfig) -> MakeNetwork:
    """What makes the networks of a config."""
    return MLP if config.shares_a_trunk else partial(_TRUNKS[config.architecture], modules=config.modules)


def parameters_of(network: nn.Module) -> int:
    """How many numbers a network learns."""
    weights: list[Tensor] = list(network.parameters())
    return sum(weight.numel() for weight in weights)

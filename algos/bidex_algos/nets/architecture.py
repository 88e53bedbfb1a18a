"""The choice of the network between observation and output, and the critics of actions that are built from it."""

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor, nn

from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.multitask import Moore, PaCo, SoftModules, Towers, Transformer
from bidex_algos.nets.networks import MLP, Activation, Layers, MakeNetwork
from bidex_meta.errors import BidexError
from bidex_meta.training.learner import LearnerConfig
from bidex_meta.utils.validation import Count, Whole, Widths

Options = dict[str, Any]  # fields of a config by name
Architecture = Literal["shared", "multi_head", "towers", "separate", "soft_modules", "paco", "moore", "transformer"]
_TRUNKS: dict[str, MakeNetwork] = {
    "soft_modules": SoftModules, "paco": PaCo, "moore": Moore, "transformer": Transformer,
    "towers": partial(Towers, shared=1), "separate": partial(Towers, shared=0),
}  # fmt: skip


@dataclass(frozen=True)
class ArchitectureConfig(LearnerConfig):
    """Layers of actor and critics, and how they share weights between tasks."""

    architecture: Architecture = "shared"
    """shared: one trunk for all tasks. multi_head: that with policy_heads and value_heads. towers: the first layer
    alone is common; separate: none is. soft_modules, paco, moore, transformer: other trunks, each with or without
    heads. All but shared for MT suites, whose observations show the task."""
    modules: Count = 4  # Modules of a layer of soft_modules, parameter sets of paco, experts of moore, attention heads.
    hidden: Layers = (256, 256)  # Widths of the hidden layers, of actor and critics alike.
    activation: Activation = "relu"  # Non-linearity of the hidden layers.

    @property
    def shares_a_trunk(self) -> bool:
        """Return whether the trunk is the plain one."""
        return self.architecture in ("shared", "multi_head")


@dataclass(frozen=True)
class NetworkConfig(ArchitectureConfig):
    """Networks of actor and critics; raises BidexError if the layers do not fit the architecture."""

    policy_heads: bool = False  # Give the actor an output layer per task; the world must show the task's one-hot.
    task_embedding: Whole = 0
    """Size of a learned vector that each network reads in the place of the task's one-hot; 0: the one-hot itself."""
    point_widths: Widths = (32, 64)
    """Widths of the layers that all points of a point cloud share (PointNet), where the world shows one."""
    points_read: Whole = 0  # Points of a cloud that they read, evenly out of all; 0: all.

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.architecture in ("multi_head", "towers", "separate"):
            for heads in ("policy_heads", "value_heads"):
                object.__setattr__(self, heads, True)  # so that a checkpoint's config has them too
        if self.shares_a_trunk:
            return
        if self.task_embedding:
            raise BidexError(
                f"{self.algo}: task_embedding goes with architecture shared or multi_head, got {self.architecture}, "
                "which reads the task its own way. Leave task_embedding off."
            )
        layers = {name: widths for name, widths in vars(self).items() if name in ("hidden", "critic_hidden")}
        for name, widths in layers.items():
            if self.architecture == "soft_modules" and len(widths) < 2:
                raise BidexError(
                    f"{self.algo}: soft_modules needs at least two widths in {name}, one of the embedding and one "
                    f"for each layer of modules; got {widths}."
                )
            if self.architecture == "moore" and not (widths and self.modules <= widths[-1]):
                raise BidexError(
                    f"{self.algo}: moore needs no more modules than the last width of {name}, since no more "
                    f"directions are orthogonal there; got {self.modules} and {widths}."
                )
            if self.architecture == "transformer" and (len({*widths}) != 1 or widths[0] % self.modules):
                raise BidexError(
                    f"{self.algo}: transformer needs one width for all of {name}, a multiple of modules; got {widths} "
                    f"and {self.modules}."
                )


def network_of(config: ArchitectureConfig) -> MakeNetwork:
    """Return the constructor of a config's networks."""
    trunk = _TRUNKS.get(config.architecture)
    if trunk is None:
        return MLP
    return partial(trunk, modules=config.modules)


def network_bytes(hidden: tuple[int, ...], width: int, copies: int) -> int:
    """Return the bytes of ``copies`` networks on observations of a ``width``, with gradient and Adam's two moments."""
    widths = (width, *hidden)
    return 4 * 4 * copies * sum(a * b for a, b in zip(widths, hidden, strict=False))


class Critics(nn.Module):
    """``count`` networks of observation and action that differ only in their initial weights.

    ``inputs`` are the groups of observation and action together; ``heads`` is the number of outputs of each network,
    one per task or 1. Two networks reduce overestimation (Fujimoto et al. 2018).
    """

    def __init__(
        self, inputs: Inputs, heads: int, config: ArchitectureConfig, layer_norm: bool, generator: torch.Generator,
        count: int = 2
    ):  # fmt: skip
        super().__init__()
        self.heads = heads
        network = network_of(config)
        given = inputs, config.hidden, heads, 1.0, generator, config.activation, layer_norm
        self.nets = nn.ModuleList(network(*given) for _ in range(count))

    def forward(self, obs: Tensor, actions: Tensor, task_id: Tensor) -> Tensor:
        """Return values of actions: normalised observations (B, d), actions (B, a), tasks (B,) to (count, B)."""
        x = torch.cat([obs, actions], dim=1)
        all_values = torch.stack([net(x) for net in self.nets])
        if self.heads == 1:
            return all_values.squeeze(2)
        return all_values.gather(2, task_id.expand(len(self.nets), -1)[..., None]).squeeze(2)


@torch.no_grad()
def follow(target: nn.Module, network: nn.Module, tau: float) -> None:
    """Move a target network a share ``tau`` of the way to its network (Polyak averaging)."""
    for behind, ahead in zip(target.parameters(), network.parameters(), strict=True):
        behind.lerp_(ahead, tau)

"""The choice of the network between observation and output, and the critics that are built from such networks."""

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, Protocol

import torch
from torch import Tensor, nn

from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.multitask import Moore, PaCo, SoftModules, Towers, Transformer
from bidex_algos.nets.networks import MLP, Activation, Layers, MakeNetwork
from bidex_meta.errors import BidexError
from bidex_meta.training.learner import LearnerConfig
from bidex_meta.utils.validation import Whole, Widths

Options = dict[str, Any]  # fields of a config by name
Architecture = Literal["shared", "multi_head", "towers", "separate", "soft_modules", "paco", "moore", "transformer"]
_TRUNKS: dict[str, MakeNetwork] = {
    "soft_modules": SoftModules, "paco": PaCo, "moore": Moore, "transformer": Transformer,
    "towers": partial(Towers, shared=1), "separate": partial(Towers, shared=0),
}  # fmt: skip
_MODULES = 4  # modules per layer of soft_modules, parameter sets of paco, experts of moore, attention heads


class Networks(Protocol):
    """The fields of a learner's config that its networks are built from."""

    @property
    def algo(self) -> str:
        """The learner's name in messages."""
        ...

    @property
    def architecture(self) -> Architecture:
        """Return the form of weight sharing between tasks."""
        ...

    @property
    def hidden(self) -> Layers:
        """Widths of the hidden layers."""
        ...

    @property
    def activation(self) -> Activation:
        """Non-linearity of the hidden layers."""
        ...


@dataclass(frozen=True)
class NetworkConfig(LearnerConfig):
    """Options of the networks of actor and critics; raises BidexError if the layers do not fit the architecture."""

    architecture: Architecture = "shared"
    """shared: one trunk for all tasks. multi_head: the same trunk with policy_heads and value_heads. towers: tasks
    share only the first layer. separate: tasks share no layer. soft_modules, paco, moore, transformer: other trunks,
    each with or without heads. All except shared need an MT suite, whose observations show the task."""
    hidden: Layers = (256, 256)  # Widths of the hidden layers, the same for actor and critics.
    activation: Activation = "relu"  # Non-linearity of the hidden layers.
    policy_heads: bool = False  # Give the actor an output layer per task; the world must show the task's one-hot.
    task_embedding: Whole = 0
    """Size of a learned vector that each network reads instead of the task's one-hot; 0: networks read the one-hot."""
    point_widths: Widths = (32, 64)
    """Widths of the layers that all points of a point cloud share (PointNet), if the world shows a point cloud."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_networks(self)


def check_networks(config: Networks) -> None:
    """Raise BidexError if a config's layers do not fit its architecture.

    If the architecture gives each task its own output layer, switch on ``policy_heads`` and ``value_heads``.
    """
    architecture = config.architecture
    if architecture in ("multi_head", "towers", "separate"):
        for heads in ("policy_heads", "value_heads"):
            object.__setattr__(config, heads, True)  # stores the value, so that a checkpoint's config contains it
    if shares_a_trunk(architecture):
        return
    if vars(config).get("task_embedding"):
        raise BidexError(
            f"{config.algo}: task_embedding goes with architecture shared or multi_head, got {architecture}, "
            "which reads the task its own way. Leave task_embedding off."
        )
    layers = {name: widths for name, widths in vars(config).items() if name in ("hidden", "critic_hidden")}
    for name, widths in layers.items():
        if architecture == "soft_modules" and len(widths) < 2:
            raise BidexError(
                f"{config.algo}: soft_modules needs at least two widths in {name}, one of the embedding and one "
                f"for each layer of modules; got {widths}."
            )
        if architecture == "moore" and not (widths and widths[-1] >= _MODULES):
            raise BidexError(
                f"{config.algo}: moore has {_MODULES} experts, whose outputs are orthogonal; the last width of {name} "
                f"must be at least {_MODULES}, got {widths}."
            )
        if architecture == "transformer" and (len({*widths}) != 1 or widths[0] % _MODULES):
            raise BidexError(
                f"{config.algo}: transformer needs one width for all of {name}, a multiple of its {_MODULES} attention "
                f"heads; got {widths}."
            )


def shares_a_trunk(architecture: Architecture) -> bool:
    """Return whether all tasks share one plain network."""
    return architecture in ("shared", "multi_head")


def network_of(config: Networks) -> MakeNetwork:
    """Return the constructor of a config's networks."""
    trunk = _TRUNKS.get(config.architecture)
    if trunk is None:
        return MLP
    return partial(trunk, modules=_MODULES)


def network_bytes(hidden: tuple[int, ...], width: int, copies: int) -> int:
    """Return the bytes that ``copies`` networks take with their gradients and Adam's two moments.

    ``width`` is the number of entries of an observation.
    """
    widths = (width, *hidden)
    return 4 * 4 * copies * sum(a * b for a, b in zip(widths, hidden, strict=False))


class Critics(nn.Module):
    """``count`` critics: networks of observation and action that differ only in their initial weights.

    ``inputs`` describes the input of each network: the observation, followed by the action. ``heads`` is the number of
    outputs of each network, one per task or 1. Two networks reduce overestimation (Fujimoto et al. 2018).
    """

    def __init__(
        self, inputs: Inputs, heads: int, config: Networks, layer_norm: bool, generator: torch.Generator,
        count: int = 2
    ):  # fmt: skip
        super().__init__()
        self.heads = heads
        network = network_of(config)
        given = inputs, config.hidden, heads, 1.0, generator, config.activation, layer_norm
        self.nets = nn.ModuleList(network(*given) for _ in range(count))

    def forward(self, obs: Tensor, actions: Tensor, task_id: Tensor) -> Tensor:
        """Return the critics' values (count, B) of actions (B, a) for normalised observations (B, d) and tasks (B,)."""
        x = torch.cat([obs, actions], dim=1)
        all_values = torch.stack([net(x) for net in self.nets])
        if self.heads == 1:
            return all_values.squeeze(2)
        return all_values.gather(2, task_id.expand(len(self.nets), -1)[..., None]).squeeze(2)


@torch.no_grad()
def follow(target: nn.Module, network: nn.Module, tau: float) -> None:
    """Move the weights of ``target`` a share ``tau`` of the way to those of ``network`` (Polyak averaging)."""
    for behind, ahead in zip(target.parameters(), network.parameters(), strict=True):
        behind.lerp_(ahead, tau)

"""Which network stands between observation and output."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from bidex_algos.nets.multitask import Moore, PaCo, SoftModules
from bidex_algos.nets.networks import MLP, Activation, Layers
from bidex_meta.errors import BidexError
from bidex_meta.train.learner import LearnerConfig
from bidex_meta.utils.validation import Count, Whole, Widths

MakeNetwork = Callable[..., Any]
"""Takes the arguments of :class:`~bidex_algos.nets.networks.MLP`."""

Architecture = Literal["shared", "multi_head", "soft_modules", "paco", "moore"]
_TRUNKS: dict[str, MakeNetwork] = {"soft_modules": SoftModules, "paco": PaCo, "moore": Moore}


@dataclass(frozen=True)
class ArchitectureConfig(LearnerConfig):
    """How actor and critics share weights between tasks. A config derived from it has ``hidden`` and the heads too."""

    architecture: Architecture = "shared"
    """shared: one trunk for all tasks. multi_head: that with policy_heads and value_heads. soft_modules, paco, moore:
    other trunks, each with or without heads; for MT suites, whose observations show the task."""
    modules: Count = 4
    """Modules of a layer of soft_modules, parameter sets of paco, experts of moore."""

    @property
    def shares_a_trunk(self) -> bool:
        """Whether the trunk is the plain one."""
        return self.architecture in ("shared", "multi_head")

    def __post_init__(self) -> None:
        super().__post_init__()
        config: Any = self
        if self.architecture == "multi_head":
            for heads in ("policy_heads", "value_heads"):
                object.__setattr__(self, heads, True)  # so that a checkpoint's config has them too
        if self.shares_a_trunk:
            return
        if config.task_embedding:
            raise BidexError(
                f"{self.algo}: task_embedding goes with architecture shared or multi_head, got {self.architecture}, "
                "which has task weights of its own. Leave task_embedding off."
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


@dataclass(frozen=True)
class NetworkConfig(ArchitectureConfig):
    """Networks of actor and critics."""

    hidden: Layers = (256, 256)
    """Widths of the hidden layers, of actor and critics alike."""
    activation: Activation = "relu"
    """Non-linearity of the hidden layers."""
    policy_heads: bool = False
    """Give the actor an output layer per task; the world must show the task's one-hot."""
    task_embedding: Whole = 0
    """Size of a learned vector that each network reads in the place of the task's one-hot; 0: the one-hot itself."""
    point_widths: Widths = (32, 64)
    """Widths of the layers that all points of a point cloud share (PointNet), where the world shows one."""
    points_read: Whole = 0
    """Points of a cloud that they read, evenly out of all; 0: all."""


def network_of(config: ArchitectureConfig) -> MakeNetwork:
    """The constructor of a config's networks."""
    trunk = _TRUNKS.get(config.architecture)
    return MLP if trunk is None else partial(trunk, modules=config.modules)


def network_bytes(hidden: tuple[int, ...], width: int, copies: int) -> int:
    """Bytes of a network's layers on observations of a width, with gradient and Adam's two moments, so many times."""
    widths = (width, *hidden)
    return 4 * 4 * copies * sum(a * b for a, b in zip(widths, hidden, strict=False))

"""Which network stands between observation and output; imports no torch, so that a command line can show it at once."""

from dataclasses import dataclass
from typing import Any

from bidex_algos.checks import at_least
from bidex_algos.choices import Architecture
from bidex_meta.errors import BidexError


@dataclass(frozen=True)
class ArchitectureConfig:
    """How actor and critics share weights between tasks. A config made of this has ``hidden`` and the heads too."""

    architecture: Architecture = "shared"
    """shared: one trunk for all tasks. multi_head: that with policy_heads and value_heads. soft_modules, paco, moore:
    other trunks, each with or without heads; for MT suites, whose observations show the task."""
    modules: int = 4
    """Modules of a layer of soft_modules, parameter sets of paco, experts of moore."""

    @property
    def shares_a_trunk(self) -> bool:
        """Whether the trunk is the plain one."""
        return self.architecture in ("shared", "multi_head")

    def _check_architecture(self) -> None:
        """Makes multi_head the heads that it stands for, and refuses what does not go together."""
        config: Any = self
        at_least(self, 1, "modules")
        if self.architecture == "multi_head":
            for heads in ("policy_heads", "value_heads"):
                object.__setattr__(self, heads, True)  # so that a checkpoint's config tells what there is
        if self.shares_a_trunk:
            return
        if config.task_embedding:
            raise BidexError(
                f"{config.algo}: task_embedding goes with architecture shared or multi_head, got {self.architecture}, "
                "which has task weights of its own. Leave task_embedding off."
            )
        for name in ("hidden", "critic_hidden"):
            widths = getattr(self, name, config.hidden)
            if self.architecture == "soft_modules" and len(widths) < 2:
                raise BidexError(
                    f"{config.algo}: soft_modules needs at least two widths in {name}, one of the embedding and one "
                    f"for each layer of modules; got {widths}."
                )
            if self.architecture == "moore" and not (widths and self.modules <= widths[-1]):
                raise BidexError(
                    f"{config.algo}: moore needs no more modules than the last width of {name}, since no more "
                    f"directions are orthogonal there; got {self.modules} and {widths}."
                )

"""What can be set about the on-policy learners of several agents; imports no torch."""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import tyro

from bidex_algos.checks import at_least, positive
from bidex_algos.onpolicy.config import OnPolicyConfig
from bidex_algos.onpolicy.ppo_config import PPOConfig
from bidex_meta.errors import BidexError
from bidex_meta.hands.units import partition_line

Partition = Annotated[str, tyro.conf.arg(aliases=("--agents",))]
"""A partition of the hands' units, on the command line by a short name too."""


def keep_partition(config: Any) -> None:
    """Puts a file's partition itself in the place of its path: a checkpoint shall know it without the file.

    Raises:
        BidexError: ``agents`` is no partition, or the agents' networks would be none of their own.
    """
    if config.architecture != "shared":
        raise BidexError(f"{config.algo}: each agent has a plain network; architecture must be shared.")
    object.__setattr__(config, "agents", partition_line(config.agents))


@dataclass(frozen=True)
class MultiAgentConfig(OnPolicyConfig):
    """Agents and the critic's loss."""

    algo: ClassVar[str] = "multi-agent"

    agents: Partition = "hands"
    """Who acts: hands (two agents), fingers (twelve: five fingers and the palm of each hand), single, a TOML file with
    a table [agents], or name=unit+unit;name=unit (docs/learners/multiagent.md)."""
    huber_delta: float = 10.0
    """Error of the critic, in its own units, beyond which its loss grows no faster than the error."""
    value_clip: float = 0.0
    """How far a value may leave the old one before it earns nothing more; 0: as far as it likes."""
    popart: bool = False
    """When the statistics of returns change, move the critic's output layer so that its values stay as they were."""
    max_grad_norm: float = 1.0
    """Gradients longer than this are shortened to it: each agent's, and the critic's."""
    critic_learning_rate: float = 1e-3
    """Adam's step size of the critic."""
    num_minibatches: int = 4
    """Mini-batches per epoch; each holds shuffled samples of all rows."""
    adam_eps: float = 1e-8
    """What Adam adds to its denominators."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range, or ``agents`` is no partition.
        """
        super().__post_init__()
        keep_partition(self)
        positive(self, "huber_delta", "max_grad_norm", "critic_learning_rate", "adam_eps")
        at_least(self, 0.0, "value_clip")
        if self.popart and not (self.per_task_values and self.value_heads):
            raise BidexError(
                f"{self.algo}: popart moves the critic's output of each task; leave per_task_values and value_heads on."
            )


@dataclass(frozen=True)
class MultiAgentPPOConfig(PPOConfig, MultiAgentConfig):
    """What IPPO, MAPPO and HAPPO share; the defaults are the preset ``laptop``."""

    critic_learning_rate: float = 1e-3
    """Adam's step size of the critic."""
    value_loss_weight: float = 1.0
    """Factor of the value loss. Adam undoes it; it matters only beside max_grad_norm."""
    entropy_weight: float = 0.0
    """Factor of the entropy bonus."""
    desired_kl: float = 0.03
    """KL of the sampling policy from the current one, of all agents together, that the adaptive step sizes aim at; each
    agent's has an even share."""

    def __post_init__(self) -> None:
        """Rejects values that could only fail later.

        Raises:
            BidexError: A field is out of its range.
        """
        super().__post_init__()
        self._check_ppo()


@dataclass(frozen=True)
class InTurnConfig:
    """What HAPPO and HATRPO share. A config that is made of this and others puts its fields behind theirs."""

    max_factor: float = 4.0
    """The most that the ratios of the agents before it, new policy over old, may multiply an agent's advantage with; 0:
    as much as it comes to."""

    def _check_turns(self) -> None:
        """Refuses a factor that is out of its range."""
        at_least(self, 0, "max_factor")
        if 0 < self.max_factor < 1:
            raise BidexError(f"max_factor: expected 0 or at least 1, which is no change at all, got {self.max_factor}.")


PAPER: dict[str, Any] = {
    "hidden": (1024, 1024, 512),
    "popart": True,
    "rollout_steps": 8,
    "gamma": 0.96,
    "lam": 0.95,
    "normalise_observations": False,
    "huber_delta": 10.0,
    "value_clip": 0.2,
}
"""What Tables 44 (HAPPO) and 45 (MAPPO) of the Bi-DexHands appendix agree on, in their columns for other tasks than
LiftUnderarm; B.2.1 and B.2.4 have the clipped value."""

PAPER_PPO: dict[str, Any] = PAPER | {
    "num_minibatches": 1,
    "epochs": 5,
    "clip": 0.2,
    "adaptive_learning_rate": False,
    "entropy_weight": 0.0,
}
"""The same with the two tables' passes and clip."""

LIFT: dict[str, Any] = {"rollout_steps": 20, "epochs": 10}
"""Both tables' column for LiftUnderarm, where it differs."""

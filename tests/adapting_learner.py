"""The least a learner that adapts must be, for the commands' tests: it learns nothing, its policy is a ``Finder``."""

from dataclasses import dataclass

import torch

from bidex_meta.training.learner import AutoresetMode, Capability
from bidex_meta.training.learner import Learner as Contract
from bidex_meta.world.contract import State, VectorWorld
from tests.points import Finder


@dataclass(frozen=True)
class Config:
    """What the meta-test reads."""

    max_adapt_steps: int = 6
    """Longest episode."""
    tasks_per_class: int = 3
    """Of a meta-batch."""


PRESETS = {"laptop": Config(), "paper": Config(8)}


class Learner(Contract):
    name = "finder"
    presets = PRESETS
    capabilities = frozenset({Capability.ADAPTS})

    def __init__(self, world: VectorWorld, config: Config, seed: int):
        self.mode = world.metadata["autoreset_mode"].name
        self.rows, self.env_steps = world.num_envs, 0
        self.seed = seed

    @classmethod
    def autoreset_mode(cls, config: Config) -> AutoresetMode:
        return "DISABLED"

    def iterate(self) -> dict[str, float]:
        self.env_steps += self.rows
        return {}

    def policy_state_dict(self) -> State:
        return {"weights": torch.tensor([float(self.seed)])}

    @classmethod
    def load_policy(cls, state: State, device: str) -> Finder:
        return Finder()

    def state_dict(self) -> State:
        return {"policy": self.policy_state_dict(), "mode": self.mode, "env_steps": self.env_steps}

    def load_state_dict(self, state: State) -> None:
        self.env_steps = state["env_steps"]

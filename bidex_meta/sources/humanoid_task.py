"""Gymnasium's humanoid as a source: a class on its own that is not of hands, stepped on the CPU in C MuJoCo."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from bidex_meta.errors import BidexError
from bidex_meta.memory import check_memory
from bidex_meta.sources.source import Source

if TYPE_CHECKING:
    from bidex_meta.evaluation.references import Reference
    from bidex_meta.tasks.base import TaskClass
    from bidex_meta.world.contract import PooledWorld

HUMANOID = "gymnasium/Humanoid-v5"
"""How a run names it (``--task``)."""

_EVALUATION_ROWS = 50
_ROW_BYTES = 2_000_000


class HumanoidTask(Source):
    """``clients/humanoid_world.py``, whose one task has neither a test split nor references nor pictures."""

    on_gpu = False
    default_episodes = _EVALUATION_ROWS
    class_name = HUMANOID

    def __init__(self, name: str, config: Mapping[str, Any]) -> None:
        super().__init__(name, config)
        for flag, least in (("points", 0), ("object", None), ("base", "own")):
            if (given := config.get(flag, least)) != least:
                raise BidexError(f"--{flag} is of the classes with hands, got {given} with {HUMANOID}. Leave it out.")

    def world(self, split: str = "train", rows: int | None = None, mode: str = "DISABLED") -> "PooledWorld":
        """As in ``Source``."""
        self._check_foreign(split, f"{self.name} runs")
        from bidex_meta.clients.humanoid_world import HumanoidWorld

        rows = rows or _EVALUATION_ROWS
        check_memory(rows * _ROW_BYTES, f"{rows:,} rows", "Lower --num-envs.")
        return HumanoidWorld(rows, seed=self.seed, autoreset_mode=mode, threads=self.threads)

    def tasks(self, split: str) -> dict[str, list[str]]:
        """As in ``Source``."""
        return {"Humanoid-v5": ["0"]} if split == "train" else {}

    def task_classes(self) -> "dict[str, TaskClass]":
        """As in ``Source``: refused."""
        raise BidexError(f"Pictures and references are made of classes with hands, got {self.name}. Name another.")

    def identity(self) -> dict[str, Any]:
        """As in ``Source``: the physics is Gymnasium's, known by its package's version."""
        return {"physics": None, "suite_version": None}

    def references(self) -> "dict[str, Reference]":
        """As in ``Source``: none."""
        return {}

"""A run as one file of JSON, for tables and pictures when its folder, with the weights, is gone.

::

    {"format": 1, "name": ..., "arm": ..., "suite": {"name", "version"}, "config": {...}, "versions": {...},
     "engine": "c", "steps": N, "seconds": S, "parameters": P,
     "curves": {"step": [...], "Train/return/<class>": [...], ...},
     "evaluation": {...}}

``python -m tools.collect`` of the repository writes such files. :func:`open_run` reads them and run folders alike.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal, TypedDict

from msgspec import Meta

from bidex_meta.config import RunConfig, config_of
from bidex_meta.errors import BidexError
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.folder import RunFolder
from bidex_meta.runs.schemas import check_evaluation, check_versions
from bidex_meta.utils.files import read_json
from bidex_meta.utils.validation import Finite, NonNegative, Text, Whole, parse

FORMAT = 1  # of the files; raised where an older reader would misread them


class _File(TypedDict):
    format: Annotated[int, Meta(ge=FORMAT, le=FORMAT)]
    name: Text
    arm: Text
    suite: Json | None
    config: Json
    versions: Json
    engine: Literal["c", "warp"]
    steps: Whole
    seconds: NonNegative
    parameters: Whole | None
    curves: dict[str, list[Finite | None]]
    evaluation: Json


@dataclass(frozen=True)
class StoredRun:
    """A run as one file of JSON, created by ``open``; methods as those of :class:`RunFolder`."""

    path: Path

    @classmethod
    def open(cls, path: Path) -> "StoredRun":
        """An existing file; raises BidexError where it cannot be read, or is no run."""
        stored = cls(Path(path))
        _ = stored.content
        return stored

    @cached_property
    def content(self) -> Json:
        """All of the file, checked; errors as of ``open``."""
        found = read_json(self.path, "a run's data")
        parse(found, _File, str(self.path))
        config_of(found["config"], f"{self.path}: config")
        check_versions(found["versions"], f"{self.path}: versions")
        check_evaluation(found["evaluation"], f"{self.path}: evaluation")
        curves = found["curves"]
        steps = curves.get("step", [])
        if not steps or not all(type(step) is int for step in steps) or steps != sorted(steps):
            raise BidexError(f"{self.path}: curves.step: expected rising whole numbers. Collect the run again.")
        for tag, column in curves.items():
            if len(column) != len(steps):
                raise BidexError(
                    f"{self.path}: curves.{tag}: expected {len(steps)} values as in curves.step, got {len(column)}. "
                    "Collect the run again."
                )
        return found

    @property
    def again(self) -> str:
        """The command that writes it anew, for messages."""
        return f"python -m tools.collect RUN --into {self.path.parent}"

    @property
    def evaluated(self) -> bool:
        """Always: what is not is never collected."""
        return True

    @property
    def videos_path(self) -> Path:
        """A folder that is not there."""
        return self.path.with_suffix("") / "videos"

    @property
    def arm(self) -> str:
        """What its study calls it."""
        return self.content["arm"]

    def config(self) -> RunConfig[Json]:
        """The resolved config; paths of own suites and of other runs are names alone."""
        return config_of(self.content["config"], f"{self.path}: config")

    def metrics(self) -> list[Json]:
        """Means over stretches of about equal length, at their ends."""
        curves = self.content["curves"]
        return [dict(zip(curves, row, strict=True)) for row in zip(*curves.values(), strict=True)]

    @property
    def goal(self) -> int:
        """Steps that it trained for: unfinished runs are never collected, so that fewer steps were its end."""
        config, steps = self.config(), self.content["steps"]
        return steps if config.minutes is not None else min(steps, config.steps)

    def versions(self) -> Json:
        """Packages, machine and git state."""
        return self.content["versions"]

    def evaluation(self) -> Json:
        """The final evaluation."""
        return self.content["evaluation"]


Run = RunFolder | StoredRun


def open_run(path: Path) -> Run:
    """A run by its folder, or by its file of JSON; raises BidexError where it is neither."""
    # A folder may be called so too.
    if path.suffix == ".json" and not path.is_dir():
        return StoredRun.open(path)
    return RunFolder.open(path)

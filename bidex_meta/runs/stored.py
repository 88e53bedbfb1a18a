"""The runs of a study in one JSON file, for tables and pictures after the run folders and weights are deleted.

::

    {"<run>": {"format": 1, "name": "<run>", "arm": ..., "suite": {"name", "version"}, "config": {...},
               "versions": {...}, "engine": "c", "steps": N, "seconds": S, "parameters": P,
               "curves": {"step": [...], "Train/return/<class>": [...], ...},
               "evaluation": {...}},
     ...}

``python -m tools.collect`` of the repository writes study files. :func:`open_runs` reads study files and run folders.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal, TypedDict

from msgspec import Meta

from bidex_meta.config import RunConfig, config_of
from bidex_meta.errors import BidexError, known_name, shortened
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.evaluations import Evaluated, parse_evaluation
from bidex_meta.runs.folder import RunFolder
from bidex_meta.runs.versions import parse_versions
from bidex_meta.utils.files import read_json
from bidex_meta.utils.validation import Finite, NonNegative, Text, Whole, parse

FORMAT = 1  # format of a run in these files; raised if an older reader would misread it


class _Content(TypedDict):
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
    """A run of a study's file, created by :func:`read_study`; methods are those of :class:`RunFolder`."""

    path: Path  # ``FILE:RUN``, which names the run in messages and on the command line.
    content: Json

    @property
    def again(self) -> str:
        """Return the command that writes the file again, for messages."""
        return f"python -m tools.collect RUN --into {str(self.path).rpartition(':')[0]}"

    @property
    def evaluation_path(self) -> Path:
        """Return the path of the run, because its file also holds the evaluation."""
        return self.path

    @property
    def evaluated(self) -> bool:
        """Return True, because study files contain only evaluated runs."""
        return True

    @property
    def videos_path(self) -> Path:
        """Return a folder that does not exist, because studies contain no films."""
        return self.path / "videos"

    @property
    def arm(self) -> str:
        """Return the run's arm: the name that all runs of a study have in common if they differ only in the seed."""
        return self.content["arm"]

    def config(self) -> RunConfig[Json]:
        """Return the resolved config, in which paths of users' suites and of other runs are reduced to names."""
        return config_of(self.content["config"], f"{self.path}: config")

    def metrics(self) -> list[Json]:
        """Return the run's metrics, averaged over intervals of steps, as rows by tag.

        The intervals have about the same number of steps. The step of a row is the end of its interval.
        """
        curves = self.content["curves"]
        return [dict(zip(curves, row, strict=True)) for row in zip(*curves.values(), strict=True)]

    @property
    def goal(self) -> int:
        """Return the environment steps for which the run was trained.

        The last iteration may exceed the steps of the config; the result is then the steps of the config, unless the
        run had a time limit. Study files contain only finished runs.
        """
        config = self.config()
        steps = self.content["steps"]
        if config.minutes is not None:
            return steps
        return min(steps, config.steps)

    def versions(self) -> Json:
        """Return packages, machine and git state."""
        return self.content["versions"]

    def evaluation(self) -> Evaluated:
        """Return the final evaluation."""
        return self._evaluation

    @cached_property
    def _evaluation(self) -> Evaluated:
        return parse_evaluation(self.content["evaluation"], f"{self.path}: evaluation")


Run = RunFolder | StoredRun


def open_runs(path: Path) -> list[Run]:
    """Open the run of a folder, all runs of a study's file, or one run of such a file (``FILE:RUN``).

    Raises BidexError if there is no such run, or its file is damaged.
    """
    file, _, name = str(path).rpartition(".json:")
    if path.is_dir() or not (file or path.suffix == ".json"):
        return [RunFolder.open(path)]
    if not file:
        return list(read_study(path))
    runs = {run.content["name"]: run for run in read_study(Path(f"{file}.json"))}
    return [runs[known_name(f"run of {file}.json", name, runs)]]


def read_study(file: Path) -> list[StoredRun]:
    """Read all runs of a study's file, in the file's order. Raises BidexError if it is damaged or holds no run."""
    contents = read_json(file, "a study's runs")
    if not isinstance(contents, dict) or not contents:
        raise BidexError(f"{file}: expected a table of runs by name. Collect them again.")
    runs = [StoredRun(Path(f"{file}:{name}"), content) for name, content in contents.items()]
    for name, run in zip(contents, runs, strict=True):
        _check(name, run)
    return runs


def study_text(contents: Mapping[str, Json]) -> str:
    """Return the text of a study file, which stores several runs, from the content of each run by its name.

    The text is JSON. Each entry of a run, such as its config or its curves, is on its own line.
    """
    return "{\n" + ",\n".join(f"{json.dumps(name)}: {_run_text(run)}" for name, run in contents.items()) + "\n}\n"


def _run_text(content: Json) -> str:
    entries = (f"{json.dumps(key)}: {json.dumps(value, separators=(',', ':'))}" for key, value in content.items())
    return "{\n" + ",\n".join(entries) + "\n}"


def _check(name: str, run: StoredRun) -> None:
    where = str(run.path)
    content = run.content
    parse(content, _Content, where)
    if content["name"] != name:
        raise BidexError(f"{where}: expected the name {name}, got {shortened(content['name'])}. Collect the run again.")
    run.config()
    parse_versions(content["versions"], f"{where}: versions")
    run.evaluation()
    curves = content["curves"]
    steps = curves.get("step", [])
    if not steps or not all(type(step) is int for step in steps) or steps != sorted(steps):
        raise BidexError(f"{where}: curves.step: expected rising whole numbers. Collect the run again.")
    for tag, column in curves.items():
        if len(column) != len(steps):
            raise BidexError(
                f"{where}: curves.{tag}: expected {len(steps)} values as in curves.step, got {len(column)}. "
                "Collect the run again."
            )

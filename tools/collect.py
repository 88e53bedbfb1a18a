"""``python -m tools.collect RUN... --into results/data/STUDY.json``: store evaluated runs in the repository.

The file holds all runs of a study, without weights, in the form that :mod:`bidex_meta.runs.stored` reads.
"""

import math
import re
import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import tyro
from torch import nn

from bidex_meta.errors import BidexError
from bidex_meta.experiments.policies import load_policy
from bidex_meta.experiments.sweep_plan import SweepPlan
from bidex_meta.runs.folder import RunFolder
from bidex_meta.runs.metrics import training_seconds
from bidex_meta.runs.provenance import differences
from bidex_meta.runs.stored import FORMAT, read_study, study_text
from bidex_meta.suite import load_suite, suite_names
from bidex_meta.utils.files import portable, read_text
from bidex_meta.utils.plugins import short_name

POINTS = 60
"""Points of a curve at most."""
_TAG = re.compile(
    r"(Train|Eval)/((return|success|score)(/.*)?|mean_return|success_rate|success_before_adapt|mean_episode_length)"
    r"|Perf/steps_per_second"
)
_TRAINED = "Train/return/"
_OF_SHOTS = ("success", "return", "score", "success_interval", "return_interval")
"""What is kept of a class after each shot; the evaluation after the last one has counts and lengths too."""


def collect(
    runs: tyro.conf.Positional[tuple[Path, ...]], into: Path, out: Path = Path("runs"), arm: str | None = None
) -> None:
    """Add all runs, or none, to the file of a study, and print the runs' names.

    Args:
        runs: Run folders, or the files of sweeps, of which the runs that have ended are taken.
        into: The study's file of JSON, in which a run has the name of its folder.
        out: Where a sweep's folder lies (`--out` of `bidex-meta sweep`).
        arm: What tables call these runs; None: of a sweep its arms, else the folder's name without suite and seed.

    Raises:
        BidexError: A run cannot be condensed, or it would replace another run.
    """
    contents = {run.content["name"]: run.content for run in read_study(into)} if into.exists() else {}
    added: list[str] = []
    for path, label in [named for given in runs for named in _named(given, out)]:
        folder = RunFolder.open(path)
        content = condensed(folder, arm or label, _parameters(folder))
        name = content["name"]
        known = contents.get(name)
        if name in added or (known is not None and _is_another(known["config"], content["config"])):
            raise BidexError(f"{into}:{name} is another run than {path}. Rename the run's folder, or remove the entry.")
        contents[name] = content
        added.append(name)
    into.parent.mkdir(parents=True, exist_ok=True)
    into.write_text(study_text(dict(sorted(contents.items()))))
    for name in added:
        print(f"{into}:{name}")
        if contents[name]["versions"]["git"].get("dirty"):
            print(f"{name} was made by changed code: its commit alone does not make it again.", file=sys.stderr)


def condensed(folder: RunFolder, arm: str | None, parameters: int | None) -> dict[str, Any]:
    """Return the entry of an evaluated run in the file of a study.

    Args:
        folder: The run.
        arm: The run's name in its study, without the seed; None: see :func:`arm_of`.
        parameters: Number of the policy's parameters; None if unknown.

    Raises:
        BidexError: The run is not evaluated, its evaluation is of another run or of fewer steps, or its commit is not
            known.
    """
    config, evaluation = folder.config().to_json(), folder.evaluation()
    rows, versions = folder.metrics(), folder.versions()
    _check(folder, evaluation, rows, versions)
    return {
        "format": FORMAT,
        "name": folder.path.resolve().name,
        "arm": arm or arm_of(folder.path, config),
        "suite": _suite(config["suite"]),
        "config": portable(config),
        "versions": versions,
        "engine": _engine(config),
        "steps": rows[-1]["step"],
        "seconds": _rounded(training_seconds(rows), 6),
        "parameters": parameters,
        "curves": _curves(rows),
        "evaluation": _evaluation(evaluation),
    }


def arm_of(path: Path, config: dict[str, Any]) -> str:
    """Return the name of a run's folder without suite and seed; if only a date is left, return the learner's name."""
    subject = Path(str(config["suite"] or short_name(config["task"]))).stem
    name = re.sub(r"[-_ ]*(s|seed)[-_]?\d+$", "", path.resolve().name, flags=re.IGNORECASE)
    if name.casefold().startswith(subject.casefold()):
        name = name[len(subject) :].strip("-_ ")
    return short_name(config["algo"]) if not name or re.match(r"\d{4}-\d\d-\d\d", name) else name


def _named(path: Path, out: Path) -> list[tuple[Path, str | None]]:
    """Return run folders; for a sweep, the folders of the ended runs, with the names of their arms."""
    if path.suffix != ".toml":
        return [(path, None)]
    runs = SweepPlan.read(path, out).runs
    ended = [(run.path, run.arm) for run in runs if run.folder.evaluated]
    if not ended:
        raise BidexError(f"{path}: no run of it has ended under {out}. Run it: bidex-meta sweep {path}")
    if len(ended) < len(runs):
        print(f"{path}: {len(runs) - len(ended)} of {len(runs)} runs have not ended: left out.", file=sys.stderr)
    return list(ended)


def _is_another(known: dict[str, Any], config: dict[str, Any]) -> bool:
    return any(known.get(name) != config[name] for name in ("task", "algo", "seed", "learner"))


def _parameters(folder: RunFolder) -> int | None:
    """Count the parameters of the newest policy, without the critic; return None if there is no torch module."""
    agent, _ = load_policy(folder, "cpu")
    module = agent if isinstance(agent, nn.Module) else getattr(agent, "policy", None)
    return sum(each.numel() for each in module.parameters()) if isinstance(module, nn.Module) else None


def _check(
    folder: RunFolder, evaluation: dict[str, Any], rows: Sequence[dict[str, Any]], versions: dict[str, Any]
) -> None:
    """Raise BidexError for a run whose table nobody could trust or repeat."""
    if not rows:
        raise BidexError(f"{folder.metrics_path} holds nothing: not a run that has trained. Name another.")
    steps = min(evaluation.get("steps", rows[-1]["step"]), rows[-1]["step"])
    if steps < folder.goal:
        raise BidexError(
            f"{folder.path} is evaluated at {steps:,} steps, but goes on to {folder.goal:,}. "
            f"Let it end: bidex-meta run --resume {folder.path}"
        )
    if not (versions.get("git") or {}).get("commit"):
        raise BidexError(f"{folder.path / 'versions.json'} names no commit: nobody could make this run again.")
    if evaluation.get("split", "train") != "train":
        raise BidexError(f"{folder.evaluation_path} is of {evaluation['split']} tasks. Write it anew: {folder.again}")
    other = [str(each) for each in differences(versions, evaluation.get("conditions", {})) if each.is_of_worlds]
    if other:
        raise BidexError(
            f"{folder.path} was trained with other worlds than its evaluation's: {', '.join(other)}. Evaluate it "
            "with the versions in versions.json."
        )
    trained = {tag.removeprefix(_TRAINED) for row in rows for tag in row if tag.startswith(_TRAINED)}
    parts = evaluation.get("splits", {"train": {"after": evaluation.get("policy", evaluation)}})
    missing = trained - {name for part in parts.values() for name in part["after"]["classes"]}
    if "train" in parts and missing:  # a meta-test of test tasks alone (--split test) may have no class in common
        raise BidexError(
            f"{folder.evaluation_path} is of another run: it lacks {min(missing)}. Write it anew: {folder.again}"
        )


def _suite(name: str | None) -> dict[str, Any] | None:
    """Return name and version of a suite; also the whole file if the suite is not a shipped one."""
    if name is None:
        return None
    if not name.endswith(".toml"):
        return {"name": name, "version": load_suite(name).version if name in suite_names() else None}
    suite = load_suite(Path(name))
    return {"name": suite.name, "version": suite.version, "file": read_text(Path(name), "a suite file")}


def _engine(config: dict[str, Any]) -> str:
    """Return the engine that stepped the run; the device decides ``auto``, as in ``bidex_meta.engine.choice``."""
    engine = config.get("engine", "auto")
    return engine if engine != "auto" else "warp" if str(config.get("device", "cpu")).startswith("cuda") else "c"


def _evaluation(found: dict[str, Any]) -> dict[str, Any]:
    kept = {name: value for name, value in found.items() if name != "run"}
    if "random" in found:
        kept["random"] = {"classes": _only(found["random"]["classes"], ("success", "return"))}
    if "splits" in found:
        kept["splits"] = {name: dict(part) for name, part in found["splits"].items()}
        for part in kept["splits"].values():
            if "by_shot" in part:
                part["by_shot"] = [{"classes": _only(shot["classes"], _OF_SHOTS)} for shot in part["by_shot"]]
    return _rounded(kept, 5)


def _only(classes: dict[str, Any], measures: Sequence[str]) -> dict[str, Any]:
    return {name: {measure: row.get(measure) for measure in measures} for name, row in classes.items()}


def _curves(rows: Sequence[dict[str, Any]]) -> dict[str, list[Any]]:
    """Return columns by tag: means over intervals of about equal length, with step and training time at their ends."""
    count = min(POINTS, len(rows))
    edges = [len(rows) * i // count for i in range(count + 1)]
    parts = [rows[low:high] for low, high in pairwise(edges)]
    tags = sorted({tag for row in rows for tag in row if _TAG.fullmatch(tag)})
    return {
        "step": [part[-1]["step"] for part in parts],
        **{tag: [_mean(part, tag) for part in parts] for tag in tags},
        "Perf/training_time": [_rounded(training_seconds(rows[:edge]), 6) for edge in edges[1:]],
    }


def _mean(part: Sequence[dict[str, Any]], tag: str) -> float | None:
    values = [row[tag] for row in part if row.get(tag) is not None]
    return _rounded(math.fsum(values) / len(values), 4) if values else None


def _rounded(value: Any, digits: int) -> Any:
    """Round all numbers in a nested value to significant digits."""
    if isinstance(value, dict):
        return {name: _rounded(each, digits) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(each, digits) for each in value]
    return float(f"{value:.{digits}g}") if isinstance(value, float) else value


if __name__ == "__main__":
    tyro.cli(collect)

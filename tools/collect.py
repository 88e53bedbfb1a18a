"""``python -m tools.collect RUN... --into results/data/STUDY.json``: store evaluated runs in the repository.

The file holds all runs of a study, without weights, in the form that :mod:`bidex_meta.runs.stored` reads.
"""

import math
import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import tyro
from torch import nn

import tools
from bidex_meta.config import config_of
from bidex_meta.errors import BidexError
from bidex_meta.experiments.policies import load_policy
from bidex_meta.experiments.sweep_plan import SweepPlan
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.evaluations import Evaluated, MetaTestEvaluation, evaluation_json
from bidex_meta.runs.folder import RunFolder
from bidex_meta.runs.metrics import training_seconds
from bidex_meta.runs.provenance import differences, versions_of
from bidex_meta.runs.stored import FORMAT, read_study, study_text
from bidex_meta.suite_files import load_suite, suite_names
from bidex_meta.utils.files import portable, read_text
from bidex_meta.utils.plugins import short_name
from tools.standard import check_standard

POINTS = 60
"""Largest number of points of a curve."""
_TAG = re.compile(
    r"(Train|Eval)/((return|success|score)(/.*)?|mean_return|success_rate|success_before_adapt|mean_episode_length)"
    r"|Perf/steps_per_second"
)
_TRAINED = "Train/return/"
_FREE = ("device", "engine", "deterministic", "threads", "preset", "record", "record_share")
"""Config entries that may differ if a run replaces a stored run of the same name, besides those that a resumed run may
change. The engine is compared as resolved, because ``auto`` depends on the device."""
_OF_SHOTS = ("success", "return", "score", "success_interval", "return_interval")
"""Measures of a class that are stored for each shot; the evaluation after the last shot also has counts and lengths."""


def collect(
    runs: tyro.conf.Positional[tuple[Path, ...]], into: Path, out: Path = Path("runs"), arm: str | None = None
) -> None:
    """Add all runs, or none, to the file of a study, and print the runs' names.

    Args:
        runs: Run folders or sweep files. From a sweep, all runs that have ended are added.
        into: The study's JSON file. A run's entry has the name of the run's folder.
        out: Folder that contains the folder of the sweep (`--out` of `bidex-meta sweep`).
        arm: Name of these runs in tables. Default: the sweep's arm, or the folder's name without suite and seed.

    Raises:
        BidexError: A run cannot be condensed, or it would replace another run.
    """
    contents = {run.content["name"]: run.content for run in read_study(into)} if into.exists() else {}
    added: list[str] = []
    for path, label in chain.from_iterable(_named(given, out) for given in runs):
        folder = RunFolder.open(path)
        content = condensed(folder, arm or label, _parameters(folder))
        name = content["name"]
        known = contents.get(name)
        differing = [] if known is None else _differing(known, content)
        if name in added or differing:
            told = f" ({', '.join(differing)} differ)" if differing else ""
            raise BidexError(
                f"{into}:{name} is another run than {path}{told}. Rename the run's folder, or remove the entry."
            )
        contents[name] = content
        added.append(name)
    into.parent.mkdir(parents=True, exist_ok=True)
    into.write_text(study_text(dict(sorted(contents.items()))))
    for name in added:
        print(f"{into}:{name}")
        if contents[name]["versions"]["git"].get("dirty"):
            print(f"{name} was made by changed code: its commit alone does not make it again.", file=sys.stderr)


def condensed(folder: RunFolder, arm: str | None, parameters: int | None) -> Json:
    """Return the entry of an evaluated run in the file of a study.

    ``arm`` is the run's name in its study, without the seed; with None it is the result of :func:`arm_of`.
    ``parameters`` is the number of the policy's parameters, if known. Raises BidexError if the run is not evaluated,
    its evaluation is of another run or of fewer steps, or its commit is not known.
    """
    config = folder.config().to_json()
    evaluation = folder.evaluation()
    rows = folder.metrics()
    _check(folder, evaluation, rows)
    return {
        "format": FORMAT,
        "name": folder.path.resolve().name,
        "arm": arm or arm_of(folder.path, config),
        "suite": _suite(config["suite"]),
        "config": portable(config),
        "versions": folder.versions(),
        "engine": _engine(config),
        "steps": rows[-1]["step"],
        "seconds": _rounded(training_seconds(rows), 6),
        "parameters": parameters,
        "curves": _curves(rows),
        "evaluation": _evaluation(evaluation),
    }


def arm_of(path: Path, config: Json) -> str:
    """Return the name of a run's folder without suite and seed, or the learner's name if only a date is left."""
    subject = Path(str(config["suite"] or short_name(config["task"]))).stem
    name = re.sub(r"[-_ ]*(s|seed)[-_]?\d+$", "", path.resolve().name, flags=re.IGNORECASE)
    if name.casefold().startswith(subject.casefold()):
        name = name[len(subject) :].strip("-_ ")
    return short_name(config["algo"]) if not name or re.match(r"\d{4}-\d\d-\d\d", name) else name


def _differing(known: Json, content: Json) -> list[str]:
    """Return the names of the entries that show that two entries of a study with one name are different runs."""
    one = config_of(known["config"], "the stored run's config")
    other = config_of(content["config"], "the run's config")
    names = [name for name, _, _ in one.differences(other, _FREE)]
    if known["engine"] != content["engine"]:
        names.append("engine")
    return names


def _named(path: Path, out: Path) -> list[tuple[Path, str | None]]:
    """Return the folders of the runs that a path names, each with its arm (its name in tables).

    A run folder has the arm None. From a sweep file, all runs that have ended are returned, with the arms of the sweep.
    """
    if path.suffix != ".toml":
        return [(path, None)]
    runs = SweepPlan.read(path, out).runs
    ended = [(run.path, run.arm) for run in runs if run.folder.evaluated]
    if not ended:
        raise BidexError(f"{path}: no run of it has ended under {out}. Run it: bidex-meta sweep {path}")
    if len(ended) < len(runs):
        print(f"{path}: {len(runs) - len(ended)} of {len(runs)} runs have not ended: left out.", file=sys.stderr)
    return list(ended)


def _parameters(folder: RunFolder) -> int | None:
    """Count the parameters of the newest policy, without the critic; return None if there is no torch module."""
    agent, _ = load_policy(folder, "cpu")
    module = agent if isinstance(agent, nn.Module) else getattr(agent, "policy", None)
    return sum(each.numel() for each in module.parameters()) if isinstance(module, nn.Module) else None


def _check(folder: RunFolder, evaluation: Evaluated, rows: Sequence[Json]) -> None:
    """Raise BidexError if a run's results cannot be trusted or reproduced."""
    if not rows:
        raise BidexError(f"{folder.metrics_path} is empty: the run has not trained. Name another run.")
    steps = rows[-1]["step"]
    if evaluation.steps is not None:
        steps = min(steps, evaluation.steps)
    if steps < folder.goal:
        raise BidexError(
            f"{folder.path} is evaluated at {steps:,} steps, but goes on to {folder.goal:,}. "
            f"Let it end: bidex-meta run --resume {folder.path}"
        )
    versions = versions_of(folder)
    if versions.git is None or not versions.git.commit:
        raise BidexError(f"{folder.path / 'versions.json'} names no commit, so the run cannot be repeated.")
    check_standard(folder, evaluation)
    other = [str(each) for each in differences(versions, evaluation.conditions) if each.is_of_worlds]
    if other:
        raise BidexError(
            f"{folder.path} was trained with other worlds than its evaluation's: {', '.join(other)}. Evaluate it "
            "with the versions in versions.json."
        )
    tags = set().union(*rows)
    trained = {tag.removeprefix(_TRAINED) for tag in tags if tag.startswith(_TRAINED)}
    if isinstance(evaluation, MetaTestEvaluation):
        if "train" not in evaluation.splits:
            return  # a meta-test of test tasks only (--split test) may have no class in common
        evaluated = set[str]()
        for part in evaluation.splits.values():
            evaluated |= part.after.classes.keys()
    else:
        evaluated = evaluation.policy.classes.keys()
    missing = trained - evaluated
    if missing:
        raise BidexError(
            f"{folder.evaluation_path} is of another run: it lacks {min(missing)}. Write it again: {folder.again}"
        )


def _suite(name: str | None) -> Json | None:
    """Return name and version of a suite, and the content of its file if the suite is not a shipped one."""
    if name is None:
        return None
    if not name.endswith(".toml"):
        return {"name": name, "version": load_suite(name).version if name in suite_names() else None}
    suite = load_suite(Path(name))
    return {"name": suite.name, "version": suite.version, "file": read_text(Path(name), "a suite file")}


def _engine(config: Json) -> str:
    """Return the engine that stepped the run's world; ``auto`` depends on the device (``bidex_meta.engine.choice``)."""
    engine = config.get("engine", "auto")
    if engine != "auto":
        return engine
    return "warp" if str(config.get("device", "cpu")).startswith("cuda") else "c"


def _evaluation(evaluation: Evaluated) -> Json:
    """Return the content of an evaluation, rounded to five significant digits.

    The results of random actions, and of each shot of a meta-test, keep only a few measures.
    """
    content = evaluation_json(replace(evaluation, run=None))
    if "random" in content:
        content["random"] = _only(content["random"], ("success", "return"))
    for part in content.get("splits", {}).values():
        part["by_shot"] = [_only(shot, _OF_SHOTS) for shot in part["by_shot"]]
    return _rounded(content, 5)


def _only(summary: Json, measures: Sequence[str]) -> Json:
    """Return a summary in which each class has only the given measures."""
    classes = {}
    for name, row in summary["classes"].items():
        classes[name] = {measure: row[measure] for measure in measures}
    return {"classes": classes}


def _curves(rows: Sequence[Json]) -> dict[str, list[float | None]]:
    """Return learning curves of at most ``POINTS`` points, by tag.

    The run is divided into intervals of about equal length, one for each point. A point is the mean over its interval,
    but step and training time are those at the interval's end.
    """
    count = min(POINTS, len(rows))
    edges = [len(rows) * i // count for i in range(count + 1)]
    parts = [rows[low:high] for low, high in pairwise(edges)]
    curves = {"step": [part[-1]["step"] for part in parts]}
    for tag in sorted(filter(_TAG.fullmatch, set().union(*rows))):
        curves[tag] = [_mean(part, tag) for part in parts]
    curves["Perf/training_time"] = [_rounded(training_seconds(rows[:edge]), 6) for edge in edges[1:]]
    return curves


def _mean(part: Sequence[Json], tag: str) -> float | None:
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
    tools.run(collect)

"""A run folder condensed to what :mod:`bidex_meta.record.stored` reads: some kilobytes of JSON for the repository."""

import json
import math
import re
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from bidex_meta.errors import BidexError
from bidex_meta.outside import short_name
from bidex_meta.reading import read_text
from bidex_meta.record.folder import RunFolder
from bidex_meta.record.metrics import training_seconds
from bidex_meta.record.stored import FORMAT
from bidex_meta.suite import load_suite, suite_names

MOST_BYTES = 40_000
"""Of a file."""
_POINTS = (60, 40, 25, 15, 8)
"""Points of a curve: as many of these as fit."""
_TAG = re.compile(
    r"(Train|Eval)/((return|success|score)(/.*)?|mean_return|success_rate|success_before_adapt|mean_episode_length)"
    r"|Perf/steps_per_second"
)
_TRAINED = "Train/return/"
_OF_SHOTS = ("success", "return", "score", "success_interval", "return_interval")
"""Of a class after each shot; counts and lengths stand in the last one."""


def condensed(folder: RunFolder, arm: str, parameters: int | None) -> dict[str, Any]:
    """What is kept of an evaluated run.

    Args:
        folder: The run.
        arm: What its study calls it, without the seed.
        parameters: Numbers that its policy has learned; None where that cannot be told.

    Raises:
        BidexError: It is not evaluated, its evaluation is of another run or of fewer steps, it does not say by which
            code it was made, or it has so many classes that no curve fits.
    """
    config, found = folder.config("learner", "num_envs", "steps"), folder.evaluation()
    rows, versions = folder.metrics(), folder.versions()
    _refuse_foreign(folder, found, rows, versions)
    steps, goal = rows[-1]["step"], folder.goal
    if found.get("steps", steps) < goal or steps < goal:
        raise BidexError(
            f"{folder.path} is evaluated at {min(found.get('steps', steps), steps):,} steps, but goes on to {goal:,}. "
            f"Let it end: bidex-meta run --resume {folder.path}"
        )
    made = {
        "format": FORMAT,
        "name": folder.path.resolve().name,
        "arm": arm,
        "suite": _suite(config),
        "config": _without_places(config),
        "versions": versions,
        "engine": _engine(config),
        "steps": steps,
        "seconds": _rounded(training_seconds(rows), 6),
        "parameters": parameters,
    }
    evaluation = _evaluation(found)
    for points in _POINTS:
        made |= {"curves": _curves(rows, points), "evaluation": evaluation}
        if len(told(made)) <= MOST_BYTES:
            return made
    raise BidexError(f"{folder.path} has more than {MOST_BYTES:,} bytes of results: too many classes for one file.")


def told(content: dict[str, Any]) -> bytes:
    """The file's bytes: an entry a line, of curves and classes each a line, so that differences can be read."""
    lines = []
    for name, value in content.items():
        deep = {"curves": 1, "evaluation": 3}.get(name, 0)
        lines.append(f"{json.dumps(name)}: {_text(value, deep)}")
    return ("{\n" + ",\n".join(lines) + "\n}\n").encode()


def arm_of(path: Path, config: dict[str, Any]) -> str:
    """What a run is called beside others of its study: its folder's name without suite and seed, else its learner."""
    subject = Path(str(config["suite"] or short_name(config["task"]))).stem
    name = re.sub(r"[-_ ]*(s|seed)[-_]?\d+$", "", path.resolve().name, flags=re.IGNORECASE)
    if name.casefold().startswith(subject.casefold()):
        name = name[len(subject) :].strip("-_ ")
    dated = re.match(r"\d{4}-\d\d-\d\d", name)
    return short_name(config["algo"]) if dated or not name else name


def _refuse_foreign(
    folder: RunFolder, found: dict[str, Any], rows: Sequence[dict[str, Any]], versions: dict[str, Any]
) -> None:
    if not rows:
        raise BidexError(f"{folder.metrics_path} holds nothing: not a run that has trained. Name another.")
    if not (versions.get("git") or {}).get("commit"):
        raise BidexError(
            f"{folder.path / 'versions.json'} names no commit: nobody could make this run again. Run it in a checkout."
        )
    if found.get("split", "train") != "train":
        raise BidexError(f"{folder.evaluation_path} is of {found['split']} tasks. Write it anew: {folder.again}")
    trained = {tag.removeprefix(_TRAINED) for row in rows for tag in row if tag.startswith(_TRAINED)}
    parts = found.get("splits", {"train": {"after": found.get("policy", found)}})
    strange = trained - {name for part in parts.values() for name in part["after"]["classes"]}
    if "train" in parts and strange:  # a meta-test of test tasks alone (--split test) may have no class in common
        raise BidexError(
            f"{folder.evaluation_path} is of another run: it lacks {min(strange)}. Write it anew: {folder.again}"
        )


def _suite(config: dict[str, Any]) -> dict[str, Any] | None:
    """The suite's name and version; of a file of the user's all of it, since nobody else has it."""
    name = config["suite"]
    if name is None:
        return None
    if not name.endswith(".toml"):
        return {"name": name, "version": load_suite(name).version if name in suite_names() else None}
    suite = load_suite(Path(name))
    return {"name": suite.name, "version": suite.version, "file": read_text(Path(name), "a suite file")}


def _engine(config: dict[str, Any]) -> str:
    """The physics that stepped it: what auto means by the run's device (bidex_meta.engine.choice)."""
    asked = config.get("engine", "auto")
    if asked != "auto":
        return asked
    return "warp" if str(config.get("device", "cpu")).startswith("cuda") else "c"


def _without_places(config: dict[str, Any]) -> dict[str, Any]:
    """The config without folders of this machine."""
    kept = dict(config)
    for name in ("suite", "object", "start_from"):
        if config.get(name) is not None:
            kept[name] = Path(config[name]).name if Path(config[name]).is_absolute() else config[name]
    for name in ("dataset", "demonstrations"):
        if config.get(name):
            many = [config[name]] if isinstance(config[name], str) else config[name]
            names = ["/".join(Path(each).parts[-2:]) if Path(each).is_absolute() else each for each in many]
            kept[name] = names[0] if isinstance(config[name], str) else names
    return kept


def _evaluation(found: dict[str, Any]) -> dict[str, Any]:
    kept = {name: value for name, value in found.items() if name not in ("run", "random", "splits")}
    if "random" in found:
        classes = found["random"]["classes"].items()
        kept["random"] = {"classes": {name: {m: row[m] for m in ("success", "return")} for name, row in classes}}
    if "splits" in found:
        kept["splits"] = {name: _meta_test(part) for name, part in found["splits"].items()}
    return _rounded(kept, 5)


def _meta_test(part: dict[str, Any]) -> dict[str, Any]:
    kept = dict(part)
    if "by_shot" in part:
        shots = [
            {name: {m: row.get(m) for m in _OF_SHOTS} for name, row in s["classes"].items()} for s in part["by_shot"]
        ]
        kept["by_shot"] = [{"classes": classes} for classes in shots]
    return kept


def _curves(rows: Sequence[dict[str, Any]], points: int) -> dict[str, list[Any]]:
    """Columns by tag: means over stretches of rows, told at their ends; the time of training at the ends."""
    tags = sorted({tag for row in rows for tag in row if _TAG.fullmatch(tag)})
    parts = list(_parts(rows, points))
    ends = [part[-1]["step"] for part in parts]
    done, seconds = [], []
    for part in parts:
        done += part
        seconds.append(_rounded(training_seconds(done), 6))
    return {"step": ends, **{tag: [_mean(part, tag) for part in parts] for tag in tags}, "Perf/training_time": seconds}


def _parts(rows: Sequence[dict[str, Any]], points: int) -> Iterator[list[dict[str, Any]]]:
    """Rows in at most so many stretches of about equal length."""
    count = min(points, len(rows))
    edges = [len(rows) * place // count for place in range(count + 1)]
    yield from (list(rows[low:high]) for low, high in pairwise(edges))


def _mean(part: Sequence[dict[str, Any]], tag: str) -> float | None:
    values = [row[tag] for row in part if row.get(tag) is not None]
    return _rounded(math.fsum(values) / len(values), 4) if values else None


def _rounded(value: Any, digits: int) -> Any:
    """Numbers with so many digits that count, in whatever holds them."""
    if isinstance(value, dict):
        return {name: _rounded(each, digits) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(each, digits) for each in value]
    return float(f"{value:.{digits}g}") if isinstance(value, float) else value


def _text(value: Any, deep: int) -> str:
    if not deep or not isinstance(value, dict):
        return json.dumps(value, separators=(",", ":"))
    return "{\n" + ",\n".join(f"{json.dumps(name)}: {_text(each, deep - 1)}" for name, each in value.items()) + "\n}"

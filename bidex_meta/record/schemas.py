"""What the JSON files of a run folder must hold: ``config.json`` and ``evaluation.json``, read and checked."""

from pathlib import Path
from typing import Any

from bidex_meta.errors import BidexError
from bidex_meta.reading import TABLE, TEXT, Rule, check, choice, exists, number, read_json, whole

NAMES = ("suite", "task", "algo", "seed")
"""What every run's config holds."""

_TEXTS = Rule("a list of texts", lambda value: isinstance(value, list) and all(map(TEXT.fits, value)))
CONFIG = {
    "suite": TEXT.or_none(),
    "task": TEXT.or_none(),
    "base": choice("own", "moving", "fixed"),
    "points": whole(0),
    "object": TEXT.or_none(),
    "start_from": TEXT.or_none(),
    "algo": TEXT,
    "preset": TEXT,
    "learner": TABLE,
    "num_envs": whole(1),
    "steps": whole(0),
    "minutes": number(0.0, 1e9).or_none(),
    "evaluate_every": whole(1).or_none(),
    "video_every": whole(1).or_none(),
    "logger": TEXT,
    "dataset": _TEXTS,
    "task_seed": whole(0).or_none(),
    "demonstrations": Rule("a text, a list of texts or null", lambda x: x is None or TEXT.fits(x) or _TEXTS.fits(x)),
    "record": whole(0),
    "record_share": number(0.0, 1e15),
    "stop_at_return": number(-1e12, 1e12).or_none(),
    "stop_at_success": number(0.0, 1.0).or_none(),
    "stop_at_score": number(-1e12, 1e12).or_none(),
    "processes": whole(1, 1_000_000),
    "seed": whole(0),
    "device": TEXT,
    "engine": choice("auto", "c", "warp"),
    "threads": whole(1, 4096),
}
"""What the entries of a run's config must be, where they are there: older runs have fewer."""

_CLASS = {"success": number(), "return": number(), "score": number().or_none()}
"""Entries of a class in an evaluation that are read again, beside the intervals."""


def read_config(path: Path, needed: tuple[str, ...] = ()) -> dict[str, Any]:
    """A run's config.

    Args:
        path: Its ``config.json``.
        needed: Entries that must be there beside those of every run.

    Raises:
        BidexError: The file cannot be read, is not JSON, or is not a run's.
    """
    config = read_json(path, "a run's config")
    check_config(config, path, needed)
    return config


def check_config(config: Any, path: Path, needed: tuple[str, ...] = (), place: str = "") -> None:
    """Refuses what is no run's config.

    Args:
        config: As it was read.
        path: Its file, for messages.
        needed: Entries that must be there beside those of every run.
        place: Where in the file it stands, ending in a dot, for messages.

    Raises:
        BidexError: Told of the first entry that is not what it must be.
    """
    missing = [name for name in NAMES if not isinstance(config, dict) or name not in config]
    missing = missing or [name for name in needed if name not in config]
    if missing:
        raise BidexError(f"{path} is not a run's config: it lacks {', '.join(missing)}. Name a run.")
    check(config, CONFIG, path, (), place)
    if (config["suite"] is None) == (config["task"] is None):
        raise BidexError(f"{path}: expected either a suite or a task, the other null. Name a run.")


_VERSIONS = {
    "gpus": Rule("a list of texts", lambda value: isinstance(value, list) and all(map(TEXT.fits, value))).or_none(),
    "git": TABLE.or_none(),
}


def read_versions(folder: Path) -> dict[str, Any]:
    """A run's ``versions.json``; empty where it has none.

    Raises:
        BidexError: The file cannot be read, or holds something else.
    """
    path = folder / "versions.json"
    if not exists(path):
        return {}
    found = read_json(path, "a run's versions")
    check_versions(found, path)
    return found


def check_versions(found: Any, path: Path, place: str = "") -> None:
    """Refuses what are no versions of a run; ``place`` as in :func:`check_config`.

    Raises:
        BidexError: Told of the first entry that is not what it must be.
    """
    check(found, _VERSIONS, path, (), place)
    commit = (found.get("git") or {}).get("commit")
    if commit is not None and not TEXT.fits(commit):
        raise BidexError(f"{path}: {place}git.commit: expected a text.")


def read_evaluation(path: Path, again: str) -> dict[str, Any]:
    """An evaluation, or a meta-test, as ``run`` and ``evaluate --json`` write it.

    Args:
        path: Its file.
        again: How to write it anew, for messages.

    Raises:
        BidexError: The file cannot be read, or holds something else.
    """
    try:
        found = read_json(path, "an evaluation")
        check_evaluation(found, path)
    except BidexError as error:
        raise BidexError(f"{error} Write it anew: {again}") from None
    return found


def check_evaluation(found: Any, path: Path, within: str = "") -> None:
    """Refuses what is no evaluation; ``within`` says where in the file it stands, ending in a dot.

    Raises:
        BidexError: Told of the first entry that is not what it must be.
    """
    check(found, {"steps": whole(0), "split": TEXT, "splits": TABLE, "policy": TABLE}, path, (), within)
    for name, part in found.get("splits", {}).items():
        _check_meta_test(part, path, f"{within}splits.{name}.")
    if "splits" not in found:
        of_policy = "policy" in found
        place = f"{within}policy." if of_policy else within
        _check_classes(found["policy"] if of_policy else found, path, place)


def _check_meta_test(part: Any, path: Path, place: str) -> None:
    check(part, {"before": TABLE, "after": TABLE}, path, ("before", "after"), place)
    shots = part.get("by_shot", [])
    if not isinstance(shots, list):
        raise BidexError(f"{path}: {place}by_shot: expected a list.")
    parts = {"before": part["before"], "after": part["after"]} | {f"by_shot[{i}]": each for i, each in enumerate(shots)}
    for name, each in parts.items():
        _check_classes(each, path, f"{place}{name}.")
        # Curves over shots are of the classes before them.
        check(each["classes"], {}, path, tuple(part["before"]["classes"]), f"{place}{name}.classes.")


def _check_classes(part: Any, path: Path, place: str) -> None:
    check(part, {"classes": TABLE}, path, ("classes",), place)
    if not part["classes"]:
        raise BidexError(f"{path}: {place}classes: expected at least one class, got none.")
    for name, row in part["classes"].items():
        check(row, _CLASS, path, tuple(_CLASS), f"{place}classes.{name}.")
        for measure in ("success_interval", "return_interval"):
            ends = row.get(measure)
            pair = isinstance(ends, list) and len(ends) == 2 and all(number().fits(end) for end in ends)
            if ends is not None and not pair:
                raise BidexError(f"{path}: {place}classes.{name}.{measure}: expected two numbers or null.")

"""Schemas of ``evaluation.json`` and ``versions.json`` of a run folder; other entries are allowed."""

from pathlib import Path
from typing import Annotated, NotRequired, TypedDict

from msgspec import Meta

from bidex_meta.errors import BidexError
from bidex_meta.runs.atomic import Json
from bidex_meta.utils.files import exists, read_json
from bidex_meta.utils.validation import Finite, Text, Whole, parse

_Interval = tuple[Finite, Finite] | None
_ClassResult = TypedDict(
    "_ClassResult",
    {
        "success": Finite,
        "return": Finite,
        "score": Finite | None,
        "success_interval": NotRequired[_Interval],
        "return_interval": NotRequired[_Interval],
        "episodes": NotRequired[Whole],
    },
)


class _Classes(TypedDict):
    classes: Annotated[dict[str, _ClassResult], Meta(min_length=1)]


class _Split(TypedDict):
    before: _Classes
    after: _Classes
    by_shot: NotRequired[list[_Classes]]


class _Made(TypedDict):
    packages: NotRequired[dict[str, Text | None]]
    physics: NotRequired[Text | None]
    suite_version: NotRequired[Whole | None]
    suite_digest: NotRequired[Text | None]


class _Evaluation(TypedDict):
    conditions: NotRequired[_Made]
    steps: NotRequired[Whole]
    split: NotRequired[Text]
    splits: NotRequired[dict[str, _Split]]
    policy: NotRequired[_Classes]


class _Git(TypedDict):
    commit: NotRequired[Text | None]
    dirty: NotRequired[bool]


class _Versions(_Made):
    cpus: NotRequired[Whole | None]
    gpus: NotRequired[list[Text] | None]
    git: NotRequired[_Git | None]


def read_versions(folder: Path) -> Json:
    """Return a run's ``versions.json``, checked; empty if the file is missing."""
    path = folder / "versions.json"
    if exists(path):
        return check_versions(read_json(path, "a run's versions"), str(path))
    return {}


def check_versions(content: Json, where: str) -> Json:
    """Return the same versions; raises BidexError, which begins with ``where``, for an entry of a wrong type."""
    parse(content, _Versions, where)
    return content


def read_evaluation(path: Path, again: str) -> Json:
    """Read an evaluation, or a meta-test, as ``run`` and ``evaluate --json`` write it.

    Raises BidexError if it cannot be read or is something else; ``again`` is the command that writes it again.
    """
    try:
        return check_evaluation(read_json(path, "an evaluation"), str(path))
    except BidexError as error:
        raise BidexError(f"{error} Write it anew: {again}") from None


def check_evaluation(content: Json, where: str) -> Json:
    """Return the same evaluation; raises BidexError, which begins with ``where``, for an entry of a wrong type."""
    parse(content, _Evaluation, where)
    if "splits" not in content and "policy" not in content:
        parse(content, _Classes, where)
    for name, split in content.get("splits", {}).items():
        classes = split["before"]["classes"].keys()
        for shot in (split["after"], *split.get("by_shot", ())):
            if missing := classes - shot["classes"].keys():
                raise BidexError(f"{where}: splits.{name}: expected {min(missing)} after adaptation too, found none.")
    return content

"""What ``evaluation.json`` and ``versions.json`` of a run folder must hold; entries beyond these are free."""

from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

from msgspec import Meta

from bidex_meta.errors import BidexError
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
    },
)


class _Classes(TypedDict):
    classes: Annotated[dict[str, _ClassResult], Meta(min_length=1)]


class _Split(TypedDict):
    before: _Classes
    after: _Classes
    by_shot: NotRequired[list[_Classes]]


class _Evaluation(TypedDict):
    steps: NotRequired[Whole]
    split: NotRequired[Text]
    splits: NotRequired[dict[str, _Split]]
    policy: NotRequired[_Classes]


class _Git(TypedDict):
    commit: NotRequired[Text | None]


class _Versions(TypedDict):
    gpus: NotRequired[list[Text] | None]
    git: NotRequired[_Git | None]


def read_versions(folder: Path) -> dict[str, Any]:
    """A run's ``versions.json``; empty where it has none.

    Raises:
        BidexError: The file cannot be read, or holds something else.
    """
    path = folder / "versions.json"
    return check_versions(read_json(path, "a run's versions"), str(path)) if exists(path) else {}


def check_versions(content: Any, where: str) -> dict[str, Any]:
    """The same versions; ``where`` for messages.

    Raises:
        BidexError: Names the first entry that is not what it must be.
    """
    parse(content, _Versions, where)
    return content


def read_evaluation(path: Path, again: str) -> dict[str, Any]:
    """An evaluation, or a meta-test, as ``run`` and ``evaluate --json`` write it.

    Args:
        path: Its file.
        again: How to write it anew, for messages.

    Raises:
        BidexError: The file cannot be read, or holds something else.
    """
    try:
        return check_evaluation(read_json(path, "an evaluation"), str(path))
    except BidexError as error:
        raise BidexError(f"{error} Write it anew: {again}") from None


def check_evaluation(content: Any, where: str) -> dict[str, Any]:
    """The same evaluation; ``where`` for messages.

    Raises:
        BidexError: Names the first entry that is not what it must be.
    """
    parse(content, _Evaluation, where)
    if "splits" not in content and "policy" not in content:
        parse(content, _Classes, where)
    for name, split in content.get("splits", {}).items():
        classes = split["before"]["classes"].keys()
        for shot in (split["after"], *split.get("by_shot", ())):
            if missing := classes - shot["classes"].keys():
                raise BidexError(f"{where}: splits.{name}: expected {min(missing)} after adaptation too, found none.")
    return content

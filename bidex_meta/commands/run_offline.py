"""What ``bidex-meta run`` adds for learners from data sets: which data, what they are learned for, reading them."""

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from bidex_meta.commands.learners import ALGOS, LearnerKind, learner_kind
from bidex_meta.commands.run_demonstrations import check_goals
from bidex_meta.errors import BidexError
from bidex_meta.reading import absolute, expanded
from bidex_meta.train.launch import launch
from bidex_meta.worlds import Worlds

if TYPE_CHECKING:
    from bidex_meta.data import Dataset

UPDATES = 300_000
"""Of a run whose user names no number."""
_FORM = ("suite", "task", "base", "object", "points")


def named(given: Sequence[str]) -> tuple[str, ...]:
    """The data sets that flags name, as a config keeps them: a folder stands with its whole path."""
    return tuple(str(absolute(name)) if expanded(name).is_dir() else name for name in given)


def opened(names: Sequence[str]) -> "list[Dataset]":
    """Data sets by names or folders; errors as of ``open_dataset``: one is not there, or not complete."""
    if not names:
        return []
    from bidex_meta.data import open_dataset

    return [open_dataset(name) for name in names]


def implied(datasets: "Sequence[Dataset]") -> dict[str, Any]:
    """Suite, or task, base and object, and points, that all data sets were recorded of; empty where they tell none.

    Raises:
        BidexError: They were recorded of different ones.
    """
    told = [tuple(each.metadata.get(name) or None for name in _FORM) for each in datasets]
    if not told or told[0][:2] == (None, None):
        return {}
    _check_alike(told)
    return {name: value for name, value in zip(_FORM, told[0], strict=True) if value is not None}


def _check_alike(told: Sequence[tuple[Any, ...]]) -> None:
    """Refuses data sets of different suites or classes, or of one that differ in anything else of ``_FORM``."""
    which = sorted({str(suite or task or "elsewhere") for suite, task, *_ in told})
    suite = "Name the suite that one policy shall learn: --suite NAME, of exactly these classes."
    if len(which) > 1:
        raise BidexError(f"The data sets are of {' and '.join(which)}. {suite}")
    same = "Name some that were recorded alike"
    mends = {"base": f"{same}, or what fits all: --task NAME --base BASE.", "points": f"{same}.", "object": suite}
    usual = {"points": 0, "object": "its own"}
    for name, mend in mends.items():
        values = {each[_FORM.index(name)] or usual.get(name) for each in told}
        if len(values) > 1:
            raise BidexError(
                f"The data sets of {which[0]} differ in {name}: {' and '.join(sorted(map(str, values)))}. {mend}"
            )


def task_seed(datasets: "Sequence[Dataset]") -> int | None:
    """The seed whose tasks the data were recorded on, of several data sets the first one's: it is judged on those."""
    seeds = [each.metadata.get("seed") for each in datasets]
    return seeds[0] if seeds else None


def rows_and_steps(source: Worlds) -> tuple[int, int]:
    """Rows of the world that tells sizes and names, and updates."""
    return max(1, len(source.tasks("train"))), UPDATES


def check(kind: LearnerKind, record: int, datasets: "Sequence[Dataset]", source: Worlds) -> None:
    """Refuses what does not go together.

    Raises:
        BidexError: Told with what to add or leave out.
    """
    if not kind.offline:
        if datasets:
            names = ", ".join(name for name in ALGOS if learner_kind(name).offline)
            raise BidexError(f"{kind.name} learns by playing; --dataset goes with {names}. Leave one of them out.")
        return
    if not datasets:
        raise BidexError(f"{kind.name} learns from data. Add --dataset NAME (see bidex-meta data list).")
    if record:
        raise BidexError(f"{kind.name} does not play, so that there is nothing to record. Leave --record out.")
    if launch().count > 1:
        raise BidexError(f"{kind.name} learns in one process, here are {launch().count}. Start it without torchrun.")
    for each in datasets:
        check_goals(each, source)


def give(names: Sequence[str], learner: Any) -> None:
    """Reads the data sets and hands them to a fresh learner; errors as of ``join``."""
    from bidex_meta.data.joined import join

    datasets = opened(names)
    steps, episodes = sum(each.num_steps for each in datasets), sum(each.num_episodes for each in datasets)
    print(f"Reading {steps:,} transitions of {episodes:,} episodes.", file=sys.stderr, flush=True)
    learner.learn_from(join(datasets, learner.world))

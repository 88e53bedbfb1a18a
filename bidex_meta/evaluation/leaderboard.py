"""The leaderboard: files of entries, digests that protect them from changes, and the statistics that rank entries.

Interquartile mean, performance profile and probability of improvement are those of Agarwal et al. 2021 (arXiv
2108.13264). Intervals resample runs and the tasks of each class, so that a single run also has an interval.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from msgspec import to_builtins

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.entries import SHOTS, TRANSFER, AgentEntry, AnyEntry, Entry, Part, TransferEntry
from bidex_meta.evaluation.entry_rows import ROUNDING, ClassRow, class_row
from bidex_meta.evaluation.statistics import (
    Estimate,
    crossed_estimate,
    iqm,
    probability_of_improvement,
    share_above,
)
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.evaluations import MetaTestEvaluation
from bidex_meta.utils.files import portable, read_json
from bidex_meta.utils.validation import parse

PROFILE = (0.1, 0.5, 0.9)  # Success rates at which a performance profile is read.


def entry_name(suite: str, name: str) -> str:
    """Return the name of an entry's file."""
    return f"{suite}-{name}.json".replace(" ", "-").replace("/", "-")


def sealed(content: Json, kind: type[AnyEntry], where: str) -> Json:
    """Check the content of a new entry, and return it with the digest that shows later changes.

    Raises BidexError if the leaderboard does not accept the entry; the message begins with ``where``.
    """
    content = {**content, "receipt": {**content["receipt"], "evaluation": "0" * 32}}
    entry = parse(content, kind, where, exact=True)
    _check(entry, where)
    return {**content, "receipt": {**content["receipt"], "evaluation": _digest_of(entry)}}


def read_entry(path: Path) -> AnyEntry:
    """Read an entry; raise BidexError if the file cannot be read, does not fit the schema, or contradicts itself."""
    content = read_json(path, "an entry of the leaderboard")
    kind: type[AnyEntry] = Entry
    if path.parent.name == "trials":
        kind = AgentEntry
    elif isinstance(content, dict) and content.get("track") == TRANSFER:
        kind = TransferEntry
    entry = parse(content, kind, str(path), exact=True)
    _check(entry, str(path))
    name = entry_name(entry.suite, entry.name)
    if portable(content) != content:
        raise BidexError(f"{path}: expected no path on a machine. Submit it again.")
    if path.name != name:
        raise BidexError(f"{path}: expected a file named {name}. Submit it again.")
    if entry.receipt.evaluation != _digest_of(entry):
        raise BidexError(f"{path}: receipt.evaluation: expected the digest of the content. Submit it again.")
    return entry


def _check(entry: AnyEntry, where: str) -> None:
    """Raise BidexError for the first contradiction in an entry; the message begins with ``where``."""
    try:
        fault = next(entry.faults(), None)
    except BidexError as error:  # the suite of the entry may be unknown here, or may have changed
        raise BidexError(f"{where}: {error}") from None
    if fault is not None:
        raise BidexError(f"{where}: {fault}. Submit it again.")


def read_entries(folder: Path) -> dict[Path, AnyEntry]:
    """Read all entries in a folder and its ``trials/``; raise BidexError if one is faulty or two share a policy."""
    entries = {path: read_entry(path) for path in sorted((*folder.glob("*.json"), *folder.glob("trials/*.json")))}
    check_apart(entries)
    return entries


def check_apart(entries: Mapping[Path, AnyEntry]) -> None:
    """Raise BidexError if two entries, even of different suites, contain the same policy or transfer the same policy.

    A policy may have both an entry with its own results and an entry for transfer from it to other classes.
    """
    known: dict[str, Path] = {}
    for path, entry in entries.items():
        weights = [*entry.receipt.weights]
        if isinstance(entry, TransferEntry):
            weights.append(f"{TRANSFER} of {entry.start}")  # the run may also have an entry of its own
        for digest in weights:
            if digest in known:
                raise BidexError(f"{path} has a run of {known[digest]}: their weights are equal. Keep one of them.")
            known[digest] = path


def agent_part(evaluation: MetaTestEvaluation, where: str) -> tuple[int, Part]:
    """Extract the contents of a leaderboard entry from the meta-test of a user's own agent.

    Returns the number of evaluation episodes per task, and the results on the test tasks. Raises BidexError for a
    meta-test that the leaderboard does not accept; the message begins with ``where``.
    """
    again = 'Write it by meta_test(agent, "SUITE").save(FILE).'
    if evaluation.agent is None or evaluation.suite is None:
        raise BidexError(f"{where}: expected a meta-test of an agent that is not a run, got no agent or suite. {again}")
    if evaluation.randomisation is not None:
        raise BidexError(f"{where}: expected {evaluation.suite} without randomisation, got another. {again}")
    test = evaluation.splits.get("test")
    if test is None or len(test.by_shot) != SHOTS + 1 or not test.rewards_shown:
        raise BidexError(f"{where}: expected test tasks after 0, 1 and 2 shots, with rewards shown. {again}")
    episodes = test.before.episodes_per_task or 1
    shots = []
    for shot in test.by_shot:
        classes = {}
        for name, row in shot.classes.items():
            if row.solved is None:
                raise BidexError(f"{where}: expected the successes of each task of {name}, got none. {again}")
            classes[name] = parse(class_row([row.solved], episodes * test.trials), ClassRow, f"{where}: {name}")
            if abs(classes[name].success - row.success) > ROUNDING:
                raise BidexError(
                    f"{where}: {name}: expected the mean of its tasks, {classes[name].success:.4f}, got "
                    f"{row.success:.4f}. {again}"
                )
        shots.append(classes)
    return episodes, Part(test.trials, test.rollouts, shots)


def _digest_of(entry: AnyEntry) -> str:
    """Return the digest of all content of an entry except the digest itself."""
    content = to_builtins(replace(entry, receipt=replace(entry.receipt, evaluation="")))
    return content_digest(content)


def content_digest(content: Json) -> str:
    """Return 32 hexadecimal digits that identify JSON content."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:32]


def success_iqm(tables: Sequence[np.ndarray]) -> Estimate:
    """Return the interquartile mean of success rates over all pairs of a run and a class.

    ``tables`` has one table of success (runs, units) per class; units are tasks or episodes.
    """
    return crossed_estimate(lambda tables: float(iqm(success_rates(tables).ravel())), tables)


def profile(tables: Sequence[np.ndarray], rate: float) -> float:
    """Return the share of pairs of a run and a class whose success rate is greater than ``rate``.

    The result is one point of a performance profile. ``tables`` has one table of success (runs, units) per class.
    """
    return share_above(success_rates(tables), rate)


def improvement(a: Sequence[np.ndarray], b: Sequence[np.ndarray]) -> Estimate:
    """Return the probability that a run of ``a`` has more success in a class than a run of ``b``."""
    return crossed_estimate(lambda a, b: probability_of_improvement(success_rates(a), success_rates(b)), a, b)


def success_rates(tables: Sequence[np.ndarray]) -> np.ndarray:
    """Return success rates (runs, classes), computed from one table of success (runs, units) per class."""
    return np.stack([table.mean(axis=1) for table in tables], axis=1)

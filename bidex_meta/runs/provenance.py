"""Records of the versions that a run or an evaluation was made with, and the differences between them.

A record is ``versions.json`` of a run, ``conditions`` of an evaluation, or the present installation and suite:
``packages`` (versions by name), ``physics``, ``suite_version`` and ``suite_digest``. An entry that only one of two
records has does not count as a difference.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import NamedTuple

from bidex_meta.errors import BidexError
from bidex_meta.runs.evaluations import Conditions
from bidex_meta.runs.stored import Run
from bidex_meta.runs.versions import Versions, parse_versions

_WORLD = ("physics", "suite_version", "suite_digest")
_ENGINES = ("mujoco", "mujoco-warp", "metaworld")
Value = str | int
Record = Versions | Conditions
Subject = tuple[str | None, ...]
"""Suite, class, object and base of a run. Runs with equal subjects have the same worlds, unless versions differ."""


class Difference(NamedTuple):
    """One entry whose value differs between two records."""

    name: str
    then: Value
    now: Value

    @property
    def is_of_worlds(self) -> bool:
        """Return True if the difference is in the physics or the suite.

        In this case rewards and successes that were measured with the two versions do not come from the same
        distribution.
        """
        return self.name in _ENGINES or self.name.replace(" ", "_") in _WORLD

    def __str__(self) -> str:
        return f"{self.name} {self.then} then, {self.now} now"


def differences(then: Record, now: Record) -> list[Difference]:
    """Return the entries whose values differ between two records; packages that ``now`` does not have are ignored."""
    before = _values(then)
    differing = []
    for name, value in _values(now).items():
        if name in before and before[name] != value:
            differing.append(Difference(name, before[name], value))
    return differing


def split_by_worlds(runs: Sequence[Run]) -> list[dict[str, Value | None]]:
    """Return, for each run, the versions that are not equal in all runs on the same suite or class.

    The result of each run is a dict of its own versions, which is usually empty. The function compares the versions of
    physics engines and suite, as recorded at training and at the evaluation. Runs with different dicts must not be
    pooled, because their worlds differ.
    """
    records = [dict(_of_worlds(run)) for run in runs]
    seen: dict[tuple[Subject, str], set[Value]] = defaultdict(set)
    for run, record in zip(runs, records, strict=True):
        for name, value in record.items():
            seen[_subject(run), name].add(value)
    differing = []
    for run, record in zip(runs, records, strict=True):
        own = _subject(run)
        names = [name for (subject, name), values in seen.items() if subject == own and len(values) > 1]
        differing.append({name: record.get(name) for name in names})
    return differing


def check_alike(runs: Sequence[Run]) -> None:
    """Raise BidexError if runs were made with different versions of the physics engines or of the suite.

    The runs are meant to be seeds of one experiment, so they must have the same worlds.
    """
    records = split_by_worlds(runs)
    for run, record in zip(runs, records, strict=True):
        for name, value in record.items():
            if value != records[0].get(name):
                raise BidexError(
                    f"Expected runs of equal worlds, but {runs[0].path} and {run.path} differ in {name}: "
                    f"{records[0].get(name)} and {value}. Name them in separate calls."
                )


def release_of(run: Run) -> Value | None:
    """Return the version of this package that a run was made with; None if it is not recorded."""
    return _values(versions_of(run)).get("bidex-meta")


def versions_of(run: Run) -> Versions:
    """Return the versions that a run was made with. Raises BidexError if an entry has a wrong type."""
    return parse_versions(run.versions(), f"{run.path}: versions")


def _values(record: Record) -> dict[str, Value]:
    """Return the versions in a record by name, without those that are None."""
    values: dict[str, Value | None] = dict(record.packages)
    values |= {name.replace("_", " "): getattr(record, name) for name in _WORLD}
    return {name: value for name, value in values.items() if value is not None}


def _of_worlds(run: Run) -> Iterator[tuple[str, Value]]:
    """Yield names and versions of the physics engines and the suite that a run was made with.

    The versions at training come first, followed by the versions at the evaluation, if there is an evaluation.
    """
    config = run.config()
    trained = _values(versions_of(run))
    engines = ["mujoco"]
    if config.engine == "warp" or (config.engine == "auto" and config.device.startswith("cuda")):
        engines.append("mujoco-warp")
    if (config.suite or "").startswith("metaworld/"):
        engines.append("metaworld")
    names = [*engines, *(name.replace("_", " ") for name in _WORLD)]
    yield from ((name, trained[name]) for name in names if name in trained)
    if run.evaluated:
        with suppress(BidexError):  # an unreadable evaluation is reported by the code that needs it
            evaluated = _values(run.evaluation().conditions)
            yield from ((f"evaluated with {name}", evaluated[name]) for name in names if name in evaluated)


def _subject(run: Run) -> Subject:
    config = run.config()
    return config.suite, config.task, config.object, config.base

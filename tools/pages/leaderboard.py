"""Tables of the leaderboard.

The entries are in the folder ``leaderboard/`` and in ``leaderboard/trials/``, next to the folder of data.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path
from typing import get_args

from bidex_meta.errors import BidexError
from bidex_meta.evaluation import leaderboard as board
from bidex_meta.evaluation.entries import ADAPTATION, MULTI_TASK, SHOTS, TRANSFER, AgentEntry, AnyEntry, Entry, Track
from bidex_meta.evaluation.statistics import NONE, iqm
from bidex_meta.experiments.learners import learner_class
from bidex_meta.training.learner import Capability
from tools.pages.tables import table

_TITLES = {
    MULTI_TASK: "multi-task",
    "reward-only": "adaptation, reward only",
    "privileged": "adaptation, privileged training",
    TRANSFER: "transfer to held-out classes",
}
_ENOUGH_RUNS = 5
"""Number of runs from which claims need no remark.

If learners are equal, 27 % of pairs get a claim with two runs, 15 % with three and 8 % with five (simulated with 20
classes of 50 tasks).
"""
_LAST = ["runs", "steps", "tuning", "hours", "trained on", "commit"]


def leaderboard_table(suite: str, data: Path) -> Iterator[str]:
    """Yield two tables for each track of a suite: the entries, best first, and the pairs of entries.

    A track is one of the leaderboard's competitions, such as ``multi-task``. If ``suite`` is "", the tables cover all
    suites. Raises BidexError if an entry's track is not possible for its learner.
    """
    by_path = board.read_entries(data.parent / "leaderboard")
    for path, entry in by_path.items():
        _check_track(path, entry)
    entries = list(by_path.values())
    for track in get_args(Track):
        of_track = [entry for entry in entries if entry.track == track and suite in ("", entry.suite)]
        for name in sorted({entry.suite for entry in of_track}):
            ranked = sorted((entry for entry in of_track if entry.suite == name), key=_rank, reverse=True)
            yield from (f"**{name}, {_TITLES[track]}**", "")
            head = _HEADS.get(track, _adaptation_head)()
            yield from table(["", "entry", *head, *_LAST], [_row(_place(entry, ranked), entry) for entry in ranked])
            yield ""
            if len(ranked) > 1:
                yield from table(["first", "second", "probability that the first is better", "claim"], _pairs(ranked))
                yield ""


def _check_track(path: Path, entry: AnyEntry) -> None:
    """Raise BidexError if a learner cannot be in the track of its entry, for example because it does not adapt."""
    if isinstance(entry, AgentEntry) or entry.track == TRANSFER:
        return
    try:
        kind = learner_class(entry.algorithm)
    except BidexError as error:
        raise BidexError(f"{path}: algorithm: {error}") from None
    if Capability.ADAPTS not in kind.capabilities:
        tracks = [MULTI_TASK]
    elif kind.privileges:
        tracks = ["privileged"]
    else:
        tracks = list(ADAPTATION)  # also privileged, if a run began with the policy of a run that is
    if entry.track not in tracks:
        raise BidexError(
            f"{path}: track: expected {' or '.join(tracks)} for {entry.algorithm}, got {entry.track}. Submit it again."
        )


def _multi_task_head() -> list[str]:
    above = [f"> {100 * rate:.0f} %" for rate in board.PROFILE]
    return ["new tasks, IQM", "own tasks, IQM", *above]


def _adaptation_head() -> list[str]:
    after = [f"after {shot}" for shot in range(1, SHOTS + 1)]
    return ["before", *after, f"own tasks, after {SHOTS}", "episodes per shot"]


def _transfer_head() -> list[str]:
    return ["from the run", "from scratch"]


_HEADS = {MULTI_TASK: _multi_task_head, TRANSFER: _transfer_head}


def _rank(entry: AnyEntry) -> float:
    return float(iqm(board.success_rates(entry.result).ravel()))


def _place(entry: AnyEntry, ranked: Sequence[AnyEntry]) -> int:
    """Return an entry's place; entries of equal success share it."""
    return 1 + sum(_rank(other) > _rank(entry) for other in ranked)


def _row(place: int, entry: AnyEntry) -> list[str]:
    own = NONE
    if isinstance(entry, Entry):
        own = _percent(entry.own.tables(entry.episodes))
    shots = [_percent(entry.new.tables(entry.episodes, shot)) for shot in range(len(entry.new.shots))]
    if entry.track == MULTI_TASK:
        measures = [*shots, own, *(f"{100 * board.profile(entry.result, rate):.0f} %" for rate in board.PROFILE)]
    elif entry.track == TRANSFER:
        measures = shots[::-1]
    else:
        measures = [*shots, own, _episodes_per_shot(entry)]
    tuning = f"{entry.tuning.trials} × {entry.tuning.seeds}"
    return [str(place), _label(entry), *measures, str(entry.runs), *_trained(entry, tuning)]


def _episodes_per_shot(entry: AnyEntry) -> str:
    """Return the number of exploring episodes of a task from which an entry adapts in one shot."""
    if isinstance(entry, AgentEntry):
        return NONE  # the entry does not say whether environments share their episodes
    if Capability.ADAPTS_INDEPENDENTLY in learner_class(entry.algorithm).capabilities:
        return "1"
    return str(entry.new.rollouts)


def _name(entry: AnyEntry) -> str:
    return entry.name if entry.verified else f"{entry.name} (not verified)"


def _label(entry: AnyEntry) -> str:
    """Return an entry's name and, if the name does not say it, the learner."""
    if isinstance(entry, AgentEntry) or entry.name == entry.algorithm:
        return _name(entry)
    return f"{entry.name} ({entry.algorithm})"


def _trained(entry: AnyEntry, tuning: str) -> list[str]:
    """Return the cells of steps, tuning, hours, device and commit."""
    if isinstance(entry, AgentEntry):
        return [NONE, tuning, NONE, NONE, NONE]
    stated = entry.stated
    steps = " / ".join(f"{steps:,}" for steps in sorted(set(entry.steps)))
    hours = f"{sum(stated.hours) / len(stated.hours):.2f}"
    commits = ", ".join(sorted({commit or "unknown" for commit in stated.commit}))
    return [steps, tuning, hours, stated.device, commits]


def _percent(tables: Sequence) -> str:
    return board.success_iqm(tables).text(100.0, " %")


def _pairs(ranked: Sequence[AnyEntry]) -> list[list[str]]:
    """Return a row for each pair of entries, with the probability that the first entry is better, and a claim.

    The claim names the better entry if the interval of this probability excludes 1/2. Otherwise it says that the pair
    is not separated.
    """
    rows = []
    for first, second in combinations(ranked, 2):
        found = board.improvement(first.result, second.result)
        low, high = found.interval or (0.0, 1.0)
        claim = "not separated"
        if low > 0.5:
            claim = f"{_name(first)} better than {_name(second)}"
        elif high < 0.5:
            claim = f"{_name(second)} better than {_name(first)}"
        runs = min(first.runs, second.runs)
        if claim != "not separated" and runs == 1:
            claim += " (policies of single runs)"
        elif claim != "not separated" and runs < _ENOUGH_RUNS:
            claim += f" (only {runs} runs)"
        probability = found.text(form=".2f")
        if first.runs == second.runs == len(first.result) == 1:
            probability = NONE  # one run on one class: it would always be 0, 1/2 or 1
        rows.append([_name(first), _name(second), probability, claim])
    return rows

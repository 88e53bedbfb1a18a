"""Tables of the leaderboard, from the entries in ``leaderboard/`` and its ``trials/`` next to the folder of data."""

from collections.abc import Iterator
from pathlib import Path

from bidex_meta.evaluation import leaderboard as board
from bidex_meta.evaluation.leaderboard import Entry
from bidex_meta.evaluation.statistics import iqm
from bidex_meta.runs.evaluations import Aggregate, Summary
from bidex_meta.suite import load_suite, suite_names
from tools.pages.tables import table


def leaderboard_table(suite: str, data: Path) -> Iterator[str]:
    """Yield a row for each entry of a suite in its present version, best first.

    Each row has the probability that its entry is better than the entry of the next row.
    """
    entries = {path: board.read_entry(path) for path in sorted((data.parent / "leaderboard").glob("*.json"))}
    board.check_apart(entries)
    version = load_suite(suite).version if suite in suite_names() else None
    comparable = [entry for entry in entries.values() if (entry.suite, entry.version) == (suite, version)]
    ranked = sorted(comparable, key=_rank, reverse=True)
    rows = [_row(place, entry, ranked[place:]) for place, entry in enumerate(ranked, 1)]
    above = [f"> {100 * rate:.0f} %" for rate in board.PROFILE]
    head = ["", "entry", "success, IQM", "other tasks, IQM", *above, "above the next", "runs", "steps"]
    yield from table([*head, "stated: hours", "stated: trained on", "stated: commit"], rows) if rows else ()


def trials_table(suite: str, data: Path) -> Iterator[str]:
    """Yield a row for each agent that adapts on a suite, best first; tracks stay apart."""
    folder = data.parent / "leaderboard" / "trials"
    entries = [board.read_trial_entry(path) for path in sorted(folder.glob(f"{suite}-*.json"))]
    found = []
    for entry in entries:
        test = entry.evaluation.splits["test"]
        if entry.evaluation.suite == suite:
            after = [_mean_success(shot) for shot in test.by_shot]
            gain = test.gain.aggregate["success"] if test.gain else None
            cells = [f"{100 * mean.mean:.1f} %{_ends(mean)}" for mean in after]
            cells += [gain.text(100.0, " %") if gain else "–", str(test.rollouts), "not verified"]
            found.append((entry.track, -after[-1].mean, [entry.name, entry.track, *cells]))
    head = ["agent", "training", "after 0", "after 1", "after 2", "gain", "episodes per shot", ""]
    yield from table(head, [row for *_, row in sorted(found)]) if found else ()


def _mean_success(shot: Summary) -> Aggregate:
    mean = (shot.aggregate or {})["success"]
    assert mean is not None  # ``check_trials`` refuses entries without it
    return mean


def _ends(mean: Aggregate) -> str:
    return "" if mean.interval is None else f" [{100 * mean.interval[0]:.1f}, {100 * mean.interval[1]:.1f}]"


def _rank(entry: Entry) -> float:
    return float(iqm(board.success_rates(entry.success(entry.own)).ravel()))


def _row(place: int, entry: Entry, below: list[Entry]) -> list[str]:
    own = entry.success(entry.own)
    stated = entry.stated
    better = board.improvement(own, below[0].success(below[0].own)).text(form=".2f") if below else "–"
    return [
        str(place), f"{entry.name} ({entry.algorithm})" if entry.name != entry.algorithm else entry.name,
        *(board.success_iqm(part).text(100.0, " %") for part in (own, entry.success(entry.others))),
        *(f"{100 * board.profile(own, rate):.0f} %" for rate in board.PROFILE), better,
        str(len(entry.weights)), " / ".join(f"{steps:,}" for steps in sorted(set(entry.steps))),
        f"{sum(stated.hours) / len(stated.hours):.2f}", stated.device,
        ", ".join(sorted({commit or "unknown" for commit in stated.commit})),
    ]  # fmt: skip

"""Tables of the results of ``bidex-meta validity``."""

import json
from pathlib import Path

from bidex_meta.errors import BidexError
from bidex_meta.utils.files import Json

_SHARES = {
    "blind": "blind at best",
    "named": "named by its start",
    "identified": "identified",
    "uniform": "uniform",
    "zero": "zero",
    "held": "held",
    "witness": "one witness",
    "solved": "knowing the task",
}


def validity_table(suite: str, data: Path) -> list[str]:
    """Return a suite's table from ``validity/SUITE.json`` next to the folder of data; the last row is the mean."""
    classes = read_validity(data.parent, suite)
    lines = [f"| class | hidden | {' | '.join(_SHARES.values())} | rank | return |"]
    lines.append("|---|---|" + "---|" * (len(_SHARES) + 2))
    for name, row in classes.items():
        cells = [share_cell(row, key) for key in _SHARES]
        if (aligned := row["alignment"]) is None:
            cells += ["", ""]
        # These are the rank correlation, and the mean return of successes compared with the maximum of a failing
        # policy.
        else:
            cells += [f"{aligned['rank']:.2f}", f"{aligned['solved']:.4g} / {aligned['unsolved']:.4g}"]
        lines.append(f"| {name} | {', '.join(row['hidden']) or 'nothing'} | {' | '.join(cells)} |")
    means = (_mean([row.get(key) for row in classes.values()]) for key in _SHARES)
    ranks = _mean([row["alignment"] and row["alignment"]["rank"] for row in classes.values()])
    return [*lines, f"| mean | | {' | '.join(map(_percent, means))} | {'' if ranks is None else f'{ranks:.2f}'} | |"]


def read_validity(results: Path, suite: str) -> Json:
    """Return what ``bidex-meta validity`` stored of a suite in the folder ``results``, by class; raise BidexError."""
    file = results / "validity" / f"{suite}.json"
    if not file.is_file():
        raise BidexError(f"Expected {file}. Make it: bidex-meta validity --suite {suite} --out {file}")
    classes: Json = json.loads(file.read_text())["classes"]
    return classes


def share_cell(row: Json, figure: str) -> str:
    """Format a class's value of ``figure`` as a percentage, or as "" if it was not measured.

    If ``figure`` is ``named``, the chance level follows in brackets.
    """
    cell = _percent(row.get(figure))
    if figure == "named" and cell:
        cell += f" ({100 * row['chance']:.0f} %)"
    return cell


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f} %"

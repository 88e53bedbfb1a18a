"""Tables of the results of ``bidex-meta validity``."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

from bidex_meta.errors import BidexError
from bidex_meta.utils.files import Json
from tools.pages.tables import table

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
    """Return a suite's table from ``validity/SUITE.json`` next to the folder of data.

    The last row has the mean of each column. If some classes have no value, the number of classes with a value follows
    in brackets.
    """
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
    rows = list(classes.values())
    means = [_mean_cell([row.get(key) for row in rows], 100.0, ".1f", " %") for key in _SHARES]
    means.append(_mean_cell([row["alignment"] and row["alignment"]["rank"] for row in rows], 1.0, ".2f"))
    return [*lines, f"| mean | | {' | '.join(means)} | |"]


def teachers_table(on: str, data: Path) -> Iterator[str]:
    """Yield a table of the teachers of ``validity/teachers.json`` next to the folder of data, with a row per class.

    ``on`` is not used. Raises BidexError if there is no such file.
    """
    head = ("class", "teacher", "own tasks", "unseen tasks", "own tasks, noise", "lost to noise")
    rows = []
    for name, row in read_validity(data.parent, "teachers").items():
        lost = f"{100 * (row['own'] - row['noise']):.0f} points"
        rows.append([name, row["teacher"], *(f"{100 * row[key]:.0f} %" for key in ("own", "unseen", "noise")), lost])
    yield from table(head, rows)


def read_validity(results: Path, suite: str) -> Json:
    """Return what ``bidex-meta validity`` stored of a suite in the folder ``results``, by class; raise BidexError."""
    file = results / "validity" / f"{suite}.json"
    if not file.is_file():
        command = "python -m tools.teachers" if suite == "teachers" else f"bidex-meta validity --suite {suite}"
        raise BidexError(f"Expected {file}. Make it: {command} --out {file}")
    classes: Json = json.loads(file.read_text())["classes"]
    return classes


def share_cell(row: Json, figure: str) -> str:
    """Format a class's value of ``figure`` as a percentage, or as "" if it was not measured.

    If ``figure`` is ``named``, the chance level follows in brackets, and then R² of the hidden values of unseen tasks.
    """
    cell = _percent(row.get(figure))
    if figure == "named" and cell:
        cell += f" ({100 * row['chance']:.0f} %), R² {row['explained']:.2f}"
    return cell


def _mean_cell(values: Sequence[float | None], factor: float, form: str, unit: str = "") -> str:
    """Format the mean of the known values times ``factor``; if some values are None, append how many are known."""
    known = [value for value in values if value is not None]
    if not known:
        return ""
    cell = f"{factor * sum(known) / len(known):{form}}{unit}"
    return cell if len(known) == len(values) else f"{cell} ({len(known)} of {len(values)})"


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f} %"

"""What commands print: tables for people, rows as JSON, and what they are at."""

import json
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bidex_meta.errors import one_line
from bidex_meta.evaluation.gains import Gains
from bidex_meta.evaluation.results import Difference, Evaluation, compare
from bidex_meta.evaluation.statistics import Interval
from bidex_meta.train.launch import launch

Json = dict[str, Any]  # what JSON holds, or goes into it
NONE = "–"
_BROKEN = (
    "unstable: the physics broke; no success, and the return of random actions, or its own if lower (where that is "
    "unknown: of the worst finished episode)"
)


def say(text: str) -> None:
    """To stderr, of several processes from the first alone."""
    if launch().rank == 0:
        print(text, file=sys.stderr, flush=True)


def print_rows(rows: Sequence[Json], as_json: bool, otherwise: str = "Nothing.") -> None:
    """Rows of equal keys as JSON, or as a table headed by them; ``otherwise`` in place of a table of none."""
    if as_json:
        print(json.dumps(rows, indent=2))
    elif rows:
        cells = [[", ".join(cell) if isinstance(cell, list) else cell for cell in row.values()] for row in rows]
        print_table(plain_table([name.replace("_", " ") for name in rows[0]], cells))
    else:
        print(otherwise)


def evaluation_table(
    title: str, policy: Evaluation, random: Evaluation | None = None, gains: Gains | None = None
) -> Table:
    """Success, return and score per class; beside those of a random policy with the difference; what adaptation gained.

    Both evaluations are on the same tasks.
    """
    caption = "[..] 95 % bootstrap interval over tasks (of few: episodes); success: by the suite's rule, once or at end"
    headers = ["episodes", "length", "success", "once", "at end", "return [95 %]", "score"]
    if random is not None:
        headers += ["random success", "random return [95 %]", "return above random [95 %]"]
    if gains is not None:
        headers += ["success gained [95 %]", "return gained [95 %]", "score gained [95 %]"]
        caption += "\ngained: above the same episodes before adaptation; resampled: adaptations, and their episodes"
    if any(result.unstable for result in policy.classes.values()):
        caption += f"\n{_BROKEN}"
    table = titled(title, caption, ["task"], headers)
    differences = compare(policy, random) if random is not None else {}
    rows, others = policy.to_json(), random.to_json() if random is not None else None
    for name, row in rows["classes"].items():
        episodes = f"{row['episodes']}" + (f" ({row['unstable']} unstable)" if row["unstable"] else "")
        cells = [plain(name), episodes, f"{row['length']:.1f}", percent(row["success"])]
        cells += [NONE if row[key] is None else percent(row[key]) for key in ("success_once", "success_at_end")]
        cells += [ranged(row["return"], row["return_interval"]), _score(row["score"])]
        if others is not None:
            other, difference = others["classes"][name], differences[name]
            cells += [percent(other["success"]), ranged(other["return"], other["return_interval"])]
            cells += [ranged(difference.value, difference.interval, sign=True)]
        if gains is not None:
            cells += gained(gains.classes[name])
        table.add_row(*cells)
    for key, label in (("mean", "mean over tasks"), ("iqm", "interquartile mean")):
        success, score = rows["aggregate"]["success"], rows["aggregate"]["score"]
        cells = [label, "", "", percent(success[key]), "", "", "", _score(score[key] if score else None)]
        if others is not None:
            cells += [percent(others["aggregate"]["success"][key])]
        if gains is not None and key == "mean":
            cells += gained({**gains.aggregate, "return": None})  # returns of different classes have different scales
        table.add_row(*cells, style="dim")
    return table


def result_table(title: str, policy: Evaluation, random: Evaluation) -> Table:
    """The least of ``evaluation_table``, for a terminal of 80 columns."""
    headers = ["success", "random", "return [95 %]", "random return"]
    table = titled(title, "[..] 95 % bootstrap interval over tasks", ["task"], headers)
    rows, others = policy.to_json(), random.to_json()
    for name, row in rows["classes"].items():
        other = others["classes"][name]
        cells = [percent(row["success"]), percent(other["success"]), ranged(row["return"], row["return_interval"])]
        table.add_row(plain(name), *cells, f"{other['return']:.4g}")
    means = [percent(each["aggregate"]["success"]["mean"]) for each in (rows, others)]
    table.add_row("mean over tasks", *means, style="dim")
    return table


def gained(measures: Mapping[str, Difference | None]) -> list[str]:
    """Cells of the gains in success, return and score."""
    success, earned, score = (measures[name] for name in ("success", "return", "score"))
    percents = NONE
    if success is not None:
        ends = None if success.interval is None else (100 * success.interval[0], 100 * success.interval[1])
        percents = ranged(100 * success.value, ends, sign=True, unit=" %")
    others = ((earned, ""), (score, NONE))
    return [
        percents,
        *(none if each is None else ranged(each.value, each.interval, sign=True) for each, none in others),
    ]


def plain_table(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> Table:
    """A table of anything; numbers to the right."""
    table = Table()
    for place, column in enumerate(columns):
        numbers = bool(rows) and all(isinstance(row[place], int | float) for row in rows)
        table.add_column(plain(column), justify="right" if numbers else "left")
    for row in rows:
        table.add_row(*(f"{cell:,.4g}" if isinstance(cell, float) else plain(str(cell)) for cell in row))
    return table


def titled(title: str, caption: str, left: Sequence[str], right: Sequence[str]) -> Table:
    """An empty table of columns to the left and to the right."""
    table = Table(title=escape(title), title_justify="left", caption=caption, caption_justify="left")
    for header in (*left, *right):
        table.add_column(header)
    for column in table.columns[len(left) :]:
        column.justify = "right"
    return table


def print_table(table: Table) -> None:
    """To stdout; wide enough for every column where stdout is a file or a pipe."""
    console = Console(width=None if sys.stdout.isatty() else 180)
    with console.capture() as shown:  # rich would end the process where nobody reads it
        console.print(table)
    sys.stdout.write(shown.get())


def percent(value: float) -> str:
    """``12.3 %`` of 0.123."""
    return f"{100 * value:.1f} %"


def _score(value: float | None) -> str:
    return NONE if value is None else f"{value:.1f}"


def ranged(value: float, interval: Interval | None, sign: bool = False, unit: str = "") -> str:
    """A value and the ends of its interval."""
    form = "+.4g" if sign else ".4g"
    ends = NONE if interval is None else f"{interval[0]:{form}}, {interval[1]:{form}}"
    return f"{value:{form}}{unit} \\[{ends}]"


def plain(name: str) -> str:
    """A text that rich shall show as it is: a name of a class or a task may be anybody's."""
    return escape(one_line(name))

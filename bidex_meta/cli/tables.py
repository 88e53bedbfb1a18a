"""Print tables for people, and rows of data as JSON."""

import json
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from bidex_meta.errors import one_line
from bidex_meta.evaluation.results import Difference, Evaluation, compare
from bidex_meta.evaluation.statistics import NONE, Interval
from bidex_meta.runs.evaluations import Gains, SplitSummary, Summary
from bidex_meta.utils.streams import output_width

if TYPE_CHECKING:  # torch is not imported, because lists and help do not need it
    from bidex_meta.experiments.evaluating import PlayedTasks, RunEvaluation, RunMetaTest

Json = dict[str, Any]  # a JSON object
_BROKEN = (
    "unstable: the physics broke. These episodes count as failures, with the return of random actions or their own if "
    "it is lower (where random actions were not measured: with the return of the worst finished episode)"
)


@dataclass
class Sheet:
    """A table. If it is too wide for the terminal, columns are left out, and the caption names them.

    A cell such as ``0.7 [0.6, 0.8]`` under ``return [95 %]`` becomes two columns, the number and its interval.
    Intervals are left out first, then the columns named in ``spare``, in the order of ``spare``, then the last columns.
    With ``keeps_intervals`` the columns in ``spare`` are left out before the intervals. The first two columns always
    stay, and names and numbers are never cut.
    """

    headers: Sequence[str]
    title: str = ""
    caption: str = ""
    spare: Sequence[str] = ()
    keeps_intervals: bool = False
    rows: list[list[str]] = field(default_factory=list)
    styles: list[str] = field(default_factory=list)

    def add(self, *cells: object, style: str = "") -> None:
        """Add a row, which may be shorter than the headers."""
        texts = [f"{cell:,.4g}" if isinstance(cell, float) else one_line(cell) for cell in cells]
        self.rows.append(texts + [""] * (len(self.headers) - len(texts)))
        self.styles.append(style)

    def printed(self, width: int) -> str:
        """Return the table as text that is ``width`` characters wide.

        The text is wider if the table's first two columns, which are never left out, need more.
        """
        shown = self._columns()
        left_out: list[str] = []
        for column in sorted(shown[2:], key=self._first_to_go):
            if _needed(shown) > width:
                shown.remove(column)
                left_out.append(column.header)
        caption = self.caption
        if left_out:
            caption += f"\nIn a wider terminal, or with COLUMNS=200: {', '.join(reversed(left_out))}."
        title = Text(self.title) if self.title else None
        below = Text(caption.strip()) if caption else None
        table = Table(title=title, title_justify="left", caption=below, caption_justify="left")
        for column, size in zip(shown, _widths(shown, width), strict=True):
            table.add_column(Text(column.header), justify="right" if column.is_numbers else "left", width=size)
        for number, style in enumerate(self.styles):
            table.add_row(*(Text(column.cells[number]) for column in shown), style=style or None)
        console = Console(width=max(width, _needed(shown)))
        with console.capture() as text:  # rich would end the process if nobody read the output
            console.print(table)
        return text.get()

    def _columns(self) -> list["_Column"]:
        columns = []
        for place, header in enumerate(self.headers):
            cells = [row[place] for row in self.rows]
            name, _, ends = header.rstrip("]").partition(" [")
            if not any(_RANGED.fullmatch(cell) for cell in cells):
                columns.append(_Column(place, header, cells))
                continue
            pairs = [_RANGED.fullmatch(cell) for cell in cells]
            values = [pair[1] if pair else cell for pair, cell in zip(pairs, cells, strict=True)]
            columns.append(_Column(place, name, values))
            columns.append(_Column(place, ends or "95 %", [pair[2] if pair else "" for pair in pairs], True))
        return columns

    def _first_to_go(self, column: "_Column") -> tuple[int, int]:
        if column.is_interval:
            return int(self.keeps_intervals), -column.place
        if column.header in self.spare:
            return int(not self.keeps_intervals), self.spare.index(column.header)
        return 2, -column.place


_RANGED = re.compile(r"([-+]?(?:[\d.,]+(?:e[-+]?\d+)?|nan|inf)(?: %)?) (\[.*\])")
_NUMBER = re.compile(rf"{NONE}|[-+>]? ?[\d.]+.*|\[.*\]|[-+]?(nan|inf).*|")
_PROSE = 24  # a cell of several words is wrapped from this number of letters on


@dataclass
class _Column:
    place: int  # index of the header that the column belongs to
    header: str
    cells: list[str]
    is_interval: bool = False

    @property
    def is_numbers(self) -> bool:
        return all(_NUMBER.fullmatch(cell) for cell in self.cells)

    @property
    def is_prose(self) -> bool:
        return not self.is_numbers and any(len(cell) > _PROSE and " " in cell for cell in self.cells)

    @property
    def least(self) -> int:
        """Least width in terminal columns: the widest cell, or for prose the longest word plus a margin."""
        words = self.header.split()
        if self.is_prose:
            words += " ".join(self.cells).split()
            return max(_PROSE, *map(len, words))
        return max(map(len, [*self.cells, *words]), default=1)


def _needed(columns: Sequence[_Column]) -> int:
    return sum(column.least + 3 for column in columns) + 1  # columns are separated by a rule and two spaces


def _widths(columns: Sequence[_Column], width: int) -> list[int]:
    """Return the width of each column of a table that may be ``width`` characters wide.

    Each column has at least its least width. The remaining width goes to the columns whose text would be wrapped most.
    """
    widths = [column.least for column in columns]
    wanted = [max(map(len, [*column.cells, column.header]), default=1) for column in columns]
    for _ in range(width - _needed(columns)):
        lacking = [most - size for most, size in zip(wanted, widths, strict=True)]
        if max(lacking) <= 0:
            break
        widths[lacking.index(max(lacking))] += 1
    return widths


def print_rows(rows: Sequence[Json], as_json: bool, otherwise: str = "Nothing.", spare: Sequence[str] = ()) -> None:
    """Print rows of equal keys as JSON, or as a table headed by the keys; print ``otherwise`` if there are no rows."""
    if as_json:
        print(json.dumps(rows, indent=2))
    elif rows:
        cells = [[_cell(value) for value in row.values()] for row in rows]
        print_table(plain_table([name.replace("_", " ") for name in rows[0]], cells, spare))
    else:
        print(otherwise)


def _cell(value: object) -> object:
    if value is None:
        return NONE
    return ", ".join(value) if isinstance(value, list) else value


def evaluation_table(title: str, policy: Evaluation, random: Evaluation | None = None) -> Sheet:
    """Return a table of success, return and score per class.

    With ``random`` the table also has a random policy's results on the same tasks, and the difference.
    """
    caption = "[..] 95 % bootstrap interval over tasks, or over episodes if there are few tasks"
    caption += "\nsuccess: by the suite's rule, once or at end"
    headers = ["task", "episodes", "length", "success", "once", "at end", "return [95 %]", "score"]
    if random is not None:
        headers += ["random success", "random return [95 %]", "return above random [95 %]"]
    if any(result.unstable for result in policy.classes.values()):
        caption += f"\n{_BROKEN}"
    table = Sheet(headers, title, caption, _SPARE)
    if random is not None:
        differences = compare(policy, random)
    else:
        differences = {}
    rows = policy.to_json()
    if random is not None:
        others = random.to_json()
    else:
        others = None
    for name, row in rows["classes"].items():
        episodes = f"{row['episodes']}" + (f" ({row['unstable']} unstable)" if row["unstable"] else "")
        cells = [name, episodes, f"{row['length']:.1f}", percent(row["success"])]
        cells += [NONE if row[key] is None else percent(row[key]) for key in ("success_once", "success_at_end")]
        cells += [ranged(row["return"], row["return_interval"]), _score(row["score"])]
        if others is not None:
            other = others["classes"][name]
            difference = differences[name]
            cells += [percent(other["success"]), ranged(other["return"], other["return_interval"])]
            cells += [ranged(difference.value, difference.interval, sign=True)]
        table.add(*cells)
    for key, label in (("mean", "mean over tasks"), ("iqm", "interquartile mean")):
        success = rows["aggregate"]["success"]
        score = rows["aggregate"]["score"]
        cells = [label, "", "", percent(success[key]), "", "", "", _score(score[key] if score else None)]
        if others is not None:
            cells += [percent(others["aggregate"]["success"][key])]
        table.add(*cells, style="dim")
    return table


_SPARE = ("once", "at end", "length", "episodes", "random return", "score")


def result_table(title: str, policy: Evaluation, random: Evaluation) -> Sheet:
    """Return a short form of ``evaluation_table``, with intervals if they fit."""
    headers = ["task", "success", "random", "return [95 %]", "random return"]
    table = Sheet(headers, title, "[..] 95 % bootstrap interval over tasks, or over episodes if there are few tasks")
    rows = policy.to_json()
    others = random.to_json()
    for name, row in rows["classes"].items():
        other = others["classes"][name]
        cells = [percent(row["success"]), percent(other["success"]), ranged(row["return"], row["return_interval"])]
        table.add(name, *cells, f"{other['return']:.4g}")
    means = [percent(each["aggregate"]["success"]["mean"]) for each in (rows, others)]
    table.add("mean over tasks", *means, style="dim")
    return table


def gained(measures: Mapping[str, Difference | None]) -> list[str]:
    """Return three cells of a table: the gains in success, return and score, each with its interval."""
    success, earned, score = (measures[name] for name in ("success", "return", "score"))
    percents = NONE
    if success is not None:
        percents = _percents(success.value, success.interval, sign=True)
    others = ((earned, ""), (score, NONE))
    return [
        percents,
        *(none if each is None else ranged(each.value, each.interval, sign=True) for each, none in others),
    ]


def plain_table(columns: Sequence[str], rows: Sequence[Sequence[object]], spare: Sequence[str] = ()) -> Sheet:
    """Return a table of arbitrary columns and rows."""
    table = Sheet(columns, spare=spare)
    for row in rows:
        table.add(*row)
    return table


def print_table(table: Sheet) -> None:
    """Print a table to stdout, as wide as the terminal or COLUMNS; 180 columns wide in a file or a pipe."""
    sys.stdout.write(table.printed(output_width(180)))


def print_evaluation(found: "RunEvaluation", brief: bool = False) -> None:
    """Print the tables of an evaluation.

    If ``brief`` is true and a random policy was evaluated too, the tables are short enough for a terminal.
    """
    title = f"{found.algo} on {found.worlds.name}"
    if not brief and found.own.split == "train" and 0 in found.worlds.train_tasks().values():
        title += ", tasks that training never draws"
    elif not brief:
        title += f", {found.own.split} tasks"
    title += f", {found.steps:,} steps"
    if found.worlds.config.randomisation:
        title += f", randomised by {found.worlds.config.randomisation}"
    _print_played(title, found.own, brief)
    if found.others is not None:
        others = found.others.worlds
        _print_played(f"{found.algo} on {others.name}, other tasks (seed {others.seed})", found.others, brief)


def _print_played(title: str, played: "PlayedTasks", brief: bool) -> None:
    if brief and played.random is not None:
        print_table(result_table(title, played.policy, played.random))
    else:
        print_table(evaluation_table(title, played.policy, played.random))


def print_meta_test(found: "RunMetaTest") -> None:
    """Print the tables of a meta-test, one for each split."""
    subject = f"{found.algo} on {found.worlds.name}"
    if found.steps is not None:
        subject += f", {found.steps:,} steps"
    for split, result in found.splits.items():
        table = meta_test_table(f"{subject}, {split} tasks", result.summary(), found.adapts_per_environment)
        print_table(table)


def meta_test_table(title: str, found: SplitSummary, per_environment: bool) -> Sheet:
    """Return a table of success after 0, 1, ... shots, and of the gains from no adaptation to the last shot.

    ``per_environment`` says whether each environment of a task adapts to its own episodes only. Each class has a second
    row if the evaluation episodes were also played with hidden rewards.
    """
    headers = ["task", *(f"success after {shot} [95 %]" for shot in range(found.shots + 1))]
    if per_environment:
        shot = f"a shot is one exploring episode; {found.rollouts} environments of a task adapt separately"
    else:
        shot = f"a shot has {found.rollouts} exploring episodes of a task"
    caption = f"after 0, 1, ...: after this number of shots; {shot}"
    caption += "\n[..] 95 % bootstrap interval over tasks, or over episodes if there are few tasks"
    if found.shots:
        headers.append("success gained [95 %]")
        caption += "\ngained: success after the last shot minus success before adaptation, from equal starts"
    headers += ["return before", "return", "score before", "score", "episodes"]
    if any(row.unstable for row in found.after.classes.values()):
        caption += f"\n{_BROKEN}"
    rows = {"shown": (found.by_shot, found.gain if found.shots else None)}
    if found.hidden_by_shot is not None:
        rows["hidden"] = (found.hidden_by_shot, None)
        headers.insert(1, "rewards")
    spare = ("score before", "score", "episodes", "return before", "return")
    table = Sheet(headers, title, caption, spare, keeps_intervals=True)
    for name in (*found.after.classes, None):
        for rewards, (by_shot, gain) in rows.items():
            labels = [name or "mean over tasks", rewards][: len(rows)]
            table.add(*labels, *_shot_cells(name, by_shot, gain), style="" if name else "dim")
    return table


def _shot_cells(name: str | None, by_shot: Sequence[Summary], gain: Gains | None) -> list[str]:
    """Return the cells of a class in a meta-test, or of the mean over classes if ``name`` is None.

    The mean only has cells for success, because the returns of different classes have different scales.
    """
    if name is None:
        means = [(shot.aggregate or {}).get("success") for shot in by_shot]
        cells = [NONE if mean is None else _percents(mean.mean, mean.interval) for mean in means]
        return cells if gain is None else [*cells, gained(gain.aggregate)[0]]
    rows = [shot.classes[name] for shot in by_shot]
    cells = [_percents(row.success, row.success_interval) for row in rows]
    if len(rows) > 1:
        cells.append(NONE if gain is None else gained(gain.classes[name])[0])
    ends = (rows[0], rows[-1])
    cells += [f"{row.mean_return:.4g}" for row in ends]
    cells += [_score(row.score) for row in ends]
    unstable = rows[-1].unstable
    return [*cells, f"{rows[-1].episodes}" + (f" ({unstable} unstable)" if unstable else "")]


def _percents(value: float, interval: Interval | None, sign: bool = False) -> str:
    """Format a share and the ends of its interval in per cent."""
    ends = None if interval is None else (100 * interval[0], 100 * interval[1])
    return ranged(100 * value, ends, sign, " %")


def percent(value: float) -> str:
    """Format a share in per cent: 0.123 becomes ``12.3 %``."""
    return f"{100 * value:.1f} %"


def _score(value: float | None) -> str:
    return NONE if value is None else f"{value:.1f}"


def ranged(value: float, interval: Interval | None, sign: bool = False, unit: str = "") -> str:
    """Format a value and the ends of its interval."""
    form = "+.4g" if sign else ".4g"
    if interval is None:
        ends = NONE
    else:
        ends = f"{interval[0]:{form}}, {interval[1]:{form}}"
    return f"{value:{form}}{unit} [{ends}]"

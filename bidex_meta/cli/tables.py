"""Results as tables for people."""

import sys
from collections.abc import Mapping, Sequence
from typing import Any

from rich.markup import escape
from rich.table import Table

from bidex_meta.errors import one_line
from bidex_meta.evaluation.agreement import DIFFERS, Agreement
from bidex_meta.evaluation.comparison import Group, iqm, score_over, success_over
from bidex_meta.evaluation.gains import Gains
from bidex_meta.evaluation.results import Difference, Evaluation, compare
from bidex_meta.evaluation.statistics import Interval
from bidex_meta.runs.progress import PlainConsole

_NONE = "–"
_BROKEN = (
    "unstable: the physics broke; no success, and the return of random actions, or its own if lower (where that is "
    "unknown: of the worst finished episode)"
)


def evaluation_table(
    title: str, policy: Evaluation, random: Evaluation | None = None, gains: Gains | None = None
) -> Table:
    """Success, return and score per class; beside a random policy's, where there is one, with the difference.

    Args:
        title: Heads the table.
        policy: What was found of the policy.
        random: The same of a random policy on the same tasks.
        gains: What adaptation gained.
    """
    caption = "[..] 95 % bootstrap interval over tasks (of few: episodes); success: at any step of the episode"
    headers = ["episodes", "length", "success", "return [95 %]", "score"]
    if random is not None:
        headers += ["random success", "random return [95 %]", "return above random [95 %]"]
    if gains is not None:
        headers += ["success gained [95 %]", "return gained [95 %]", "score gained [95 %]"]
        caption += "\ngained: above the same episodes before adaptation; resampled: adaptations, and their episodes"
    if any(result.unstable for result in policy.classes.values()):
        caption += f"\n{_BROKEN}"
    table = _titled(title, caption, ["task"], headers)
    differences = compare(policy, random) if random is not None else {}
    rows, others = policy.to_json(), random.to_json() if random is not None else None
    for name, row in rows["classes"].items():
        episodes = f"{row['episodes']}" + (f" ({row['unstable']} unstable)" if row["unstable"] else "")
        cells = [_name(name), episodes, f"{row['length']:.1f}", _percent(row["success"])]
        cells += [_ranged(row["return"], row["return_interval"]), _score(row["score"])]
        if others is not None:
            other, difference = others["classes"][name], differences[name]
            cells += [_percent(other["success"]), _ranged(other["return"], other["return_interval"])]
            cells += [_ranged(difference.value, difference.interval, sign=True)]
        if gains is not None:
            cells += _gained(gains.classes[name])
        table.add_row(*cells)
    for key, label in (("mean", "mean over tasks"), ("iqm", "interquartile mean")):
        success, score = rows["aggregate"]["success"], rows["aggregate"]["score"]
        cells = [label, "", "", _percent(success[key]), "", _score(score[key] if score else None)]
        if others is not None:
            cells += [_percent(others["aggregate"]["success"][key])]
        if gains is not None and key == "mean":
            cells += _gained({**gains.aggregate, "return": None})  # returns of different classes have different scales
        table.add_row(*cells, style="dim")
    return table


def _gained(measures: Mapping[str, Difference | None]) -> list[str]:
    success, earned, score = (measures[name] for name in ("success", "return", "score"))
    percent = _NONE
    if success is not None:
        ends = None if success.interval is None else (100 * success.interval[0], 100 * success.interval[1])
        percent = _ranged(100 * success.value, ends, sign=True, unit=" %")
    return [
        percent,
        "" if earned is None else _ranged(earned.value, earned.interval, sign=True),
        _NONE if score is None else _ranged(score.value, score.interval, sign=True),
    ]


def control_table(title: str, by_arm: Mapping[str, Mapping[str, Any]]) -> Table:
    """What ``bidex_meta.evaluation.control_arms.arms`` gives: an arm a row."""
    caption = (
        "gains: own data above this arm, same starts; [..] 95 % bootstrap interval over runs, adaptations, episodes"
    )
    headers = ("return", "return of each run", "success", "success gained", "return gained", "score gained")
    table = _titled(title, caption, ["adapted to"], headers)
    labels = {"before": "nothing", "own": "its own data", "foreign": "train tasks' data, mean"}
    for arm, values in by_arm.items():
        of_runs = " ".join(f"{value:.4g}" for value in values["runs"])
        cells = [
            labels.get(arm) or _name(f"data of {arm}"),
            f"{values['return']:.4g}",
            of_runs,
            _percent(values["success"]),
        ]
        table.add_row(*cells, *(_gained(values["own_minus"]) if "own_minus" in values else []))
    return table


def agreement_table(title: str, found: Sequence[Agreement]) -> Table:
    """A recorded evaluation and the same made again, a class a row."""
    caption = "within: apart by no more than both 95 % intervals allow, over all classes together"
    headers = ("success", "again", "return [95 %]", "again")
    table = _titled(title, caption, ["task", "outcome"], headers)
    for each in found:
        was, now = each.recorded, each.again
        cells = [_name(each.name), each.outcome, _percent(was["success"]), _percent(now["success"])]
        cells += [_ranged(row["return"], row.get("return_interval")) for row in (was, now)]
        table.add_row(*cells, style="bold red" if each.outcome == DIFFERS else None)
    return table


def group_table(groups: Sequence[Group]) -> tuple[list[str], list[list[str]]]:
    """Columns and rows of groups of runs beside each other, each measured against the first."""
    columns = ["group", "seeds", "steps", "hours", "success, IQM (%)", "score, IQM"]
    rows = []
    for group in groups:
        score = None if group.scores is None else iqm(group.scores)
        measures = (iqm(group.success), 100.0, ".1f"), (score, 1.0, ".1f")
        over = (success_over(group, groups[0]), 100.0, "+.1f"), (score_over(group, groups[0]), 1.0, "+.1f")
        cells = [_NONE if each is None else each.text(factor, form=form) for each, factor, form in (*measures, *over)]
        seeds = ", ".join(map(str, group.seeds))
        rows.append([group.label, seeds, group.steps_text(), f"{group.hours:.2f}", *cells])
    return [*columns, "success over the first", "score over the first"], rows


def class_table(groups: Sequence[Group]) -> tuple[list[str], list[list[str]]]:
    """Columns and rows of each class by name: mean over seeds, and the seeds' range."""
    names = list(dict.fromkeys(name for group in groups for name in group.classes))
    rows = []
    for group in groups:
        for measure, values, factor, unit in (
            ("success", group.success, 100.0, " %"),
            ("return", group.returns, 1.0, ""),
        ):
            cells = {
                name: f"{factor * of.mean():.4g}{unit} ({factor * of.min():.4g} to {factor * of.max():.4g})"
                for name, of in zip(group.classes, values.T, strict=True)
            }
            rows.append([group.label, measure, *(cells.get(name, _NONE) for name in names)])
    return ["group", "measure", *names], rows


def plain_table(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> Table:
    """A table of anything; numbers to the right."""
    table = Table()
    for place, column in enumerate(columns):
        numbers = bool(rows) and all(isinstance(row[place], int | float) for row in rows)
        table.add_column(_name(column), justify="right" if numbers else "left")
    for row in rows:
        table.add_row(*(f"{cell:,.4g}" if isinstance(cell, float) else _name(str(cell)) for cell in row))
    return table


def _titled(title: str, caption: str, left: Sequence[str], right: Sequence[str]) -> Table:
    table = Table(title=escape(title), title_justify="left", caption=caption, caption_justify="left")
    for header in left:
        table.add_column(header)
    for header in right:
        table.add_column(header, justify="right")
    return table


def print_table(table: Table) -> None:
    """To stdout; wide enough for every column where stdout is a file or a pipe."""
    PlainConsole(width=None if sys.stdout.isatty() else 180).print(table)


def _percent(value: float) -> str:
    return f"{100 * value:.1f} %"


def _score(value: float | None) -> str:
    return _NONE if value is None else f"{value:.1f}"


def _ranged(value: float, interval: Interval | None, sign: bool = False, unit: str = "") -> str:
    form = "+.4g" if sign else ".4g"
    ends = _NONE if interval is None else f"{interval[0]:{form}}, {interval[1]:{form}}"
    return f"{value:{form}}{unit} \\[{ends}]"


def _name(name: str) -> str:
    """A text that rich shall show as it is: a name of a class or a task may be anybody's."""
    return escape(one_line(name))

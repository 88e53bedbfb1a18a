"""``bidex-meta compare``: several runs beside each other, intervals over seeds."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from bidex_meta.commands.parsing import Switch, parse
from bidex_meta.errors import BidexError

if TYPE_CHECKING:
    import numpy as np

    from bidex_meta.evaluation.comparison import Estimate, Group


@dataclass(frozen=True)
class CompareFlags:
    """Compare evaluated runs; those that differ in the seed alone are one group, measured against the first group.

    Example: bidex-meta compare runs/MT4/mtppo/* runs/MT4/mttrpo/*
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN...")]
    """Run folders, or files of results/data/."""
    json: Switch = False
    """Print JSON."""
    out: Path | None = None
    """Also draw success and score of the groups, with their intervals, into this picture (.png, .svg, .pdf)."""


def main(arguments: Sequence[str]) -> None:
    """Read, compare, print.

    Raises:
        BidexError: No run is named, or one is not a run folder or not evaluated.
    """
    flags = parse(CompareFlags, arguments, "compare")
    if not flags.runs:
        raise BidexError("Name the run folders to compare: bidex-meta compare RUN RUN...")
    from bidex_meta.commands.tables import plain_table, print_table
    from bidex_meta.evaluation.comparison import estimates, read_groups
    from bidex_meta.record.stored import open_run

    groups = read_groups([open_run(path) for path in flags.runs])
    if flags.out is not None:
        from bidex_meta.record import plots

        plots.save(plots.draw_comparison(estimates(groups)), flags.out)
    if flags.json:
        print(json.dumps([_row(group, groups[0]) for group in groups], indent=2))
        return
    print_table(plain_table(["group", "seeds", "steps", "hours", *_MEASURES], [_line(g, groups[0]) for g in groups]))
    names = list(dict.fromkeys(name for group in groups for name in group.classes))
    rows = [row for group in groups for row in _classes(group, names)]
    print_table(plain_table(["group", "measure", *names], rows))
    print("IQM over seeds and classes [95 % bootstrap over seeds]. An interval that holds 0 is no difference.")


_MEASURES = ("success, IQM", "score, IQM", "success over the first", "score over the first")


def _row(group: "Group", first: "Group") -> dict[str, Any]:
    from bidex_meta.evaluation.comparison import iqm

    row: dict[str, Any] = {
        "group": group.label, "seeds": group.seeds, "steps": group.steps, "steps_range": list(group.steps_range),
        "hours": round(group.hours, 3),
    }  # fmt: skip
    for name, own, other in (("success", group.success, first.success), ("score", group.scores, first.scores)):
        row[f"{name}_iqm"] = None if own is None else vars(iqm(own))
        over = _over(own, other) if _comparable(group, first) else None
        row[f"{name}_over_first"] = None if over is None or group is first else vars(over)
    row["classes"] = {
        name: {"success": group.success[:, i].tolist(), "return": group.returns[:, i].tolist()}
        for i, name in enumerate(group.classes)
    }
    return row


def _line(group: "Group", first: "Group") -> list[object]:
    from bidex_meta.evaluation.comparison import iqm

    cells: list[object] = [group.label, len(group.seeds), group.steps_text(), f"{group.hours:.2f}"]
    cells.append(_ranged(iqm(group.success), 100.0, " %"))
    cells.append("–" if group.scores is None else _ranged(iqm(group.scores)))
    if group is first:
        return [*cells, "", ""]
    for own, other, factor, unit in (
        (group.success, first.success, 100.0, " %"),
        (group.scores, first.scores, 1.0, ""),
    ):
        over = _over(own, other) if _comparable(group, first) else None
        cells.append("–" if over is None else _ranged(over, factor, unit, sign=True))
    return cells


def _comparable(group: "Group", first: "Group") -> bool:
    """Whether both have the same classes: means over different ones have no difference."""
    return set(group.classes) == set(first.classes)


def _over(own: "np.ndarray | None", other: "np.ndarray | None") -> "Estimate | None":
    """The difference of interquartile means, where both are known."""
    from bidex_meta.evaluation.comparison import iqm_difference

    return None if own is None or other is None else iqm_difference(own, other)


def _classes(group: "Group", names: Sequence[str]) -> list[list[object]]:
    """Of each class by name: mean over seeds, and the seeds' range."""
    rows: list[list[object]] = []
    for name, values, factor, unit in (("success", group.success, 100.0, " %"), ("return", group.returns, 1.0, "")):
        cells = {
            of: f"{factor * column.mean():.4g}{unit} ({factor * column.min():.4g} to {factor * column.max():.4g})"
            for of, column in zip(group.classes, values.T, strict=True)
        }
        rows.append([group.label, name, *(cells.get(of, "–") for of in names)])
    return rows


def _ranged(estimate: "Estimate", factor: float = 1.0, unit: str = "", sign: bool = False) -> str:
    shown = estimate.text(factor, unit, "+.1f" if sign else ".1f")
    return shown if estimate.interval else f"{shown} [–]"

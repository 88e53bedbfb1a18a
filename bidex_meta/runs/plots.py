"""Curves and points of runs as figures: learning, metrics, adaptation, comparison. Needs the extra ``plot``."""

import io
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bidex_meta.errors import BidexError
from bidex_meta.runs.atomic import write_atomic
from bidex_meta.runs.schemas import check_evaluation
from bidex_meta.utils.files import exists, read_json


@dataclass(frozen=True)
class Curve:
    """A metric against environment steps; arrays (points,)."""

    steps: np.ndarray
    """Environment steps, rising."""
    mean: np.ndarray
    """The metric, over several runs their mean."""
    low: np.ndarray | None
    """Lower end of the interval over runs; None of a single run."""
    high: np.ndarray | None
    """Upper end."""


Group = tuple[str, Mapping[str, Curve]]
"""Runs that are drawn in one colour: their label, and curves by tag."""
Bar = tuple[str, float, tuple[float, float] | None]
"""A label, a value, and its interval where it is known."""

_COLUMNS = 4
_MEASURES = ("return", "success")
_STYLES = ("-", "--")
_FEW = 60
"""Evaluations up to which each is a dot: more of them would hide the dashes."""
_COLOURS = {"train": "tab:blue", "test": "tab:orange"}
_AGAIN = "Write one: bidex-meta evaluate RUN --shots 3 --json > {}"


def draw_learning(groups: Sequence[Group], families: Sequence[str] = ("Train", "Eval")) -> Any:
    """Return and success of every task against environment steps, a line for each group of runs.

    Each task has its own panels: their returns differ by orders of magnitude. Evaluations while training are dashed.

    Args:
        groups: Label and curves by tag.
        families: Of tags, in the order of their line styles; drawn where there are any.

    Returns:
        A figure.

    Raises:
        BidexError: matplotlib is missing, or no episode has ended yet.
    """
    make_figure = _figure()
    starts = [f"{family}/{measure}/" for measure in _MEASURES for family in families]
    tags = [tag for _, curves in groups for tag in curves]
    names = list(dict.fromkeys(tag[len(start) :] for tag in tags for start in starts if tag.startswith(start)))
    if not names:
        raise BidexError("There is no finished episode yet: nothing to plot.")
    columns, blocks = _grid(len(names))
    figure = make_figure(figsize=(3.2 * columns, 4.0 * blocks), layout="constrained")
    axes = figure.subplots(2 * blocks, columns, squeeze=False)
    for place in range(blocks * columns):
        for panel, measure in enumerate(_MEASURES):
            axis = axes[2 * (place // columns) + panel, place % columns]
            if place >= len(names):
                axis.set_axis_off()
                continue
            for number, (label, curves) in enumerate(groups):
                for family, style in zip(families, _STYLES, strict=False):
                    _draw_curve(axis, curves.get(f"{family}/{measure}/{names[place]}"), label, number, style)
            axis.grid(alpha=0.3)
            if panel == 0:
                axis.set_title(_plain(names[place]))
            else:
                axis.set_ylim(-0.02, 1.02)
                axis.set_xlabel("environment steps (millions)")
            if place % columns == 0:
                axis.set_ylabel(measure)
    if len(groups) > 1:
        _add_legend(figure, [label for label, _ in groups])
    return figure


def draw_metrics(groups: Sequence[Group], tags: Mapping[str, str]) -> Any:
    """Some metrics against environment steps, a panel each and a line for each group of runs.

    Args:
        groups: Label and curves by tag.
        tags: Tag to what is written beside its panel.

    Raises:
        BidexError: matplotlib is missing.
    """
    figure = _figure()(figsize=(5.2 * len(tags), 3.0), layout="constrained")
    for axis, (tag, title) in zip(figure.subplots(1, len(tags), squeeze=False).flat, tags.items(), strict=True):
        for number, (label, curves) in enumerate(groups):
            _draw_curve(axis, curves.get(tag), label, number, "-")
        axis.grid(alpha=0.3)
        axis.set_ylabel(title)
        axis.set_xlabel("environment steps (millions)")
    if len(groups) > 1:
        _add_legend(figure, [label for label, _ in groups])
    return figure


def draw_panels(panels: Mapping[str, Sequence[Group]], tag: str, title: str) -> Any:
    """One metric against environment steps, a panel for each title, all on one scale.

    Args:
        panels: Title to the groups of runs, a line each; groups of one label have one colour.
        tag: The metric.
        title: What is written beside it.

    Raises:
        BidexError: matplotlib is missing.
    """
    labels = list(dict.fromkeys(label for groups in panels.values() for label, _ in groups))
    figure = _figure()(figsize=(5.2 * len(panels), 3.6), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    for axis, (name, groups) in zip(axes, panels.items(), strict=True):
        for label, curves in groups:
            _draw_curve(axis, curves.get(tag), label, labels.index(label), "-")
        axis.set_title(_plain(name))
        axis.grid(alpha=0.3)
        axis.set_xlabel("environment steps (millions)")
    axes[0].set_ylabel(title)
    _add_legend(figure, labels)
    return figure


def draw_comparison(panels: Mapping[str, Sequence[Bar]]) -> Any:
    """Numbers of groups beside each other, as points with their intervals.

    Args:
        panels: Title to label, value and interval of each group.

    Raises:
        BidexError: matplotlib is missing.
    """
    most = max(len(bars) for bars in panels.values())
    figure = _figure()(figsize=(5.2 * len(panels), 1.2 + 0.45 * most), layout="constrained")
    for axis, (title, bars) in zip(figure.subplots(1, len(panels), squeeze=False).flat, panels.items(), strict=True):
        for place, (_, value, interval) in enumerate(bars):
            low, high = interval or (value, value)
            colour = _colour(place)
            axis.plot([low, high], [place, place], linewidth=2.5, alpha=0.5, color=colour)
            axis.plot([value], [place], marker="o", color=colour)
        axis.set_yticks(range(len(bars)), ["\n".join(textwrap.wrap(_plain(label), 40)) for label, _, _ in bars])
        axis.set_ylim(len(bars) - 0.5, -0.5)
        axis.set_title(title)
        axis.grid(alpha=0.3, axis="x")
    return figure


def draw_adaptation(found: Any, where: object) -> Any:
    """Return and success of every class against shots of adaptation, train classes first, then test classes.

    Bands are the 95 % bootstrap intervals over episodes.

    Args:
        found: Content of a run's ``evaluation.json``, or what ``bidex-meta evaluate RUN --shots K --json`` prints.
        where: Its file, for messages.

    Raises:
        BidexError: matplotlib is missing, or it holds no meta-test.
    """
    make_figure = _figure()
    splits = found.get("splits") if isinstance(found, dict) else None
    if not splits:
        raise BidexError(
            f"{where} holds no meta-test: its learner does not adapt, or it is older. {_AGAIN.format(where)}"
        )
    check_evaluation(found, str(where))
    grids = {split: _grid(len(part["before"]["classes"])) for split, part in splits.items()}
    columns, blocks = max(grid[0] for grid in grids.values()), sum(grid[1] for grid in grids.values())
    figure = make_figure(figsize=(3.2 * columns, 4.0 * blocks), layout="constrained")
    axes = figure.subplots(2 * blocks, columns, squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    first = 0
    for split, part in splits.items():
        for place, name in enumerate(part["before"]["classes"]):
            row = 2 * (first + place // grids[split][0])
            rows = [found["classes"][name] for found in part["by_shot"]]
            for panel, measure in enumerate(("return", "success")):
                axis = axes[row + panel, place % grids[split][0]]
                axis.set_axis_on()
                _draw_shots(axis, rows, measure, _COLOURS.get(split))
                if place % grids[split][0] == 0:
                    axis.set_ylabel(measure)
            axes[row, place % grids[split][0]].set_title(_plain(f"{split}: {name}"), fontsize=10)
        first += grids[split][1]
    return figure


def read_evaluation(path: Path) -> Any:
    """What an evaluation's file holds.

    Raises:
        BidexError: There is none, or it is not JSON.
    """
    if not exists(path):
        raise BidexError(f"There is no {path}. {_AGAIN.format(path)}")
    return read_json(path, "an evaluation")


def _draw_shots(axis: Any, rows: list[dict[str, Any]], measure: str, colour: str | None) -> None:
    shots = list(range(len(rows)))
    axis.plot(shots, [row[measure] for row in rows], marker="o", markersize=3, linewidth=1.2, color=colour)
    ends = [row[f"{measure}_interval"] for row in rows]
    if all(ends):
        axis.fill_between(shots, [low for low, _ in ends], [high for _, high in ends], alpha=0.2, color=colour)
    axis.grid(alpha=0.3)
    axis.set_xticks(shots)
    if measure == "success":
        axis.set_ylim(-0.02, 1.02)
        axis.set_xlabel("shots")


def missing() -> str | None:
    """What to install where nothing can be drawn; None where it can."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        return "Plots need matplotlib: pip install 'bidex-meta[plot]'."
    return None


def _figure() -> Any:
    """Matplotlib's class of figures, without its global state."""
    reason = missing()
    if reason is not None:
        raise BidexError(reason)
    from matplotlib.figure import Figure

    return Figure


def save(figure: Any, out: Path, metadata: Mapping[str, str] | None = None) -> None:
    """Write a figure.

    Args:
        figure: One of those drawn here.
        out: The picture to write; its ending names the format.
        metadata: What the file says of itself.

    Raises:
        BidexError: matplotlib does not know the ending.
    """
    known = figure.canvas.get_supported_filetypes()
    if out.suffix[1:].lower() not in known:
        raise BidexError(f"Expected a picture's ending ({', '.join(sorted(known))}), got {out.name!r}. Name it .png.")
    out.parent.mkdir(parents=True, exist_ok=True)
    ending = out.suffix[1:].lower()
    write_atomic(out, lambda file: figure.savefig(file, format=ending, dpi=120, metadata=metadata))


def svg(figure: Any) -> bytes:
    """A figure as SVG, its words as text."""
    from matplotlib import rc_context

    out = io.BytesIO()
    with rc_context({"svg.fonttype": "none"}):
        figure.savefig(out, format="svg", metadata={"Date": None})
    return out.getvalue()


def _draw_curve(axis: Any, curve: Curve | None, label: str, number: int, style: str) -> None:
    if curve is None:
        return
    steps, colour = curve.steps / 1e6, _colour(number)
    marker = "." if len(steps) == 1 or (style != "-" and len(steps) <= _FEW) else None
    axis.plot(steps, curve.mean, linewidth=1.2, color=colour, linestyle=style, marker=marker, label=_plain(label))
    if curve.low is not None and curve.high is not None:
        axis.fill_between(steps, curve.low, curve.high, alpha=0.2, color=colour, linewidth=0.0)


def _colour(number: int) -> Any:
    """The colour of a group: ten strong ones, then their light twins, then again from the first."""
    from matplotlib import colormaps

    colours = colormaps["tab20"].colors  # type: ignore[attr-defined]
    return (colours[0::2] + colours[1::2])[number % len(colours)]


def _add_legend(figure: Any, labels: Sequence[str]) -> None:
    from matplotlib.lines import Line2D

    lines = [Line2D([], [], color=_colour(number)) for number in range(len(labels))]
    inches = figure.get_size_inches()[0]
    words = ["\n".join(textwrap.wrap(_plain(label), max(20, int(12 * inches)))) for label in labels]
    longest = max(map(len, labels))
    columns = max(1, min(len(labels), int(12 * inches) // (longest + 6)))
    figure.legend(lines, words, loc="outside upper left", ncols=columns, frameon=False)


def _plain(name: str) -> str:
    """A name of the user's, in which matplotlib shall see no formulas."""
    return name.replace("$", r"\$")


def _grid(panels: int) -> tuple[int, int]:
    """Columns, and blocks of two rows, for so many tasks."""
    columns = min(_COLUMNS, panels)
    return columns, -(-panels // columns)

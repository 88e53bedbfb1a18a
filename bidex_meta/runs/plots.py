"""Figures of runs: learning curves, metrics, adaptation, comparison."""

import io
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import chain, product
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from bidex_meta.errors import BidexError
from bidex_meta.runs.atomic import write_atomic
from bidex_meta.runs.evaluations import ClassSummary, Evaluated, Interval, MetaTestEvaluation

if TYPE_CHECKING:  # matplotlib is imported only for drawing, because it takes half a second
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Curve:
    """A metric against environment steps; arrays (points,)."""

    steps: np.ndarray  # environment steps, rising
    mean: np.ndarray  # the metric; its mean if there are several runs
    low: np.ndarray | None  # lower end of the interval over runs; None for a single run
    high: np.ndarray | None  # upper end


Group = tuple[str, Mapping[str, Curve]]  # runs drawn in one colour: their label, and their curves by tag
Bar = tuple[str, float, Interval | None]  # a label, a value, and its interval if known

_COLUMNS = 4
_MEASURES = ("return", "success")
_STYLES = {"Train": "-", "Eval": "--"}  # line styles by family of tags
_FEW = 60  # maximum number of evaluations drawn as dots; more dots would hide the dashes
_COLOURS = {"train": "tab:blue", "test": "tab:orange"}
STEPS = "environment steps"
_MILLIONS = (1e6, f"{STEPS} (millions)")  # size of one unit of an axis, and the unit's name


def draw_learning(groups: Sequence[Group], steps: str = STEPS) -> "Figure":
    """Draw return and success of every task against training steps, with one line per group of runs.

    Each task has its own panels, because returns differ by orders of magnitude. Evaluations during training are dashed.
    ``steps`` says what a step is. Raises BidexError if no episode has ended yet.
    """
    starts = tuple(f"{family}/{measure}/" for measure, family in product(_MEASURES, _STYLES))
    tags = [tag for tag in chain.from_iterable(curves for _, curves in groups) if tag.startswith(starts)]
    names = list(dict.fromkeys(tag.split("/", 2)[2] for tag in tags))
    if not names:
        raise BidexError("There is nothing to plot yet, because no episode has ended.")
    figure, axes = _task_panels([names])
    for name, panels in zip(names, axes[0], strict=True):
        for axis, measure in zip(panels, _MEASURES, strict=True):
            for number, (label, curves) in enumerate(groups):
                for family, style in _STYLES.items():
                    _draw_curve(axis, curves.get(f"{family}/{measure}/{name}"), label, number, style)
            axis.grid(alpha=0.3)
        panels[0].set_title(_plain(name))
        panels[1].set_ylim(-0.02, 1.02)
        panels[1].set_xlabel(f"{steps} (millions)")
    if len(groups) > 1:
        _add_legend(figure, [label for label, _ in groups])
    return figure


def draw_metrics(groups: Sequence[Group], tags: Mapping[str, str], steps: str = STEPS) -> "Figure":
    """Draw metrics against training steps, with one panel per metric and one line per group of runs.

    ``tags`` maps the tag of each metric to the label of its panel. ``steps`` says what a step is.
    """
    figure = _figure(5.2 * len(tags), 3.0)
    labels = [label for label, _ in groups]
    for axis, (tag, title) in zip(figure.subplots(1, len(tags), squeeze=False).flat, tags.items(), strict=True):
        _draw_groups(axis, groups, tag, range(len(groups)), (1e6, f"{steps} (millions)"))
        axis.set_ylabel(title)
    if len(groups) > 1:
        _add_legend(figure, labels)
    return figure


def draw_panels(
    panels: Mapping[str, Sequence[Group]], tag: str, title: str, unit: tuple[float, str] = _MILLIONS
) -> "Figure":
    """Draw curves of a metric, with one panel for each entry of ``panels`` and a shared vertical axis.

    ``tag`` selects the metric, and ``title`` is its label. ``unit`` describes the horizontal axis: the number by which
    ``Curve.steps`` is divided, and the axis's label. By default these are millions of environment steps.
    """
    labels = list(dict.fromkeys(label for label, _ in chain.from_iterable(panels.values())))
    figure = _figure(5.2 * len(panels), 3.6)
    axes = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    for axis, (name, groups) in zip(axes, panels.items(), strict=True):
        _draw_groups(axis, groups, tag, [labels.index(label) for label, _ in groups], unit)
        axis.set_title(_plain(name))
    axes[0].set_ylabel(title)
    _add_legend(figure, labels)
    return figure


def draw_comparison(panels: Mapping[str, Sequence[Bar]]) -> "Figure":
    """Draw the value of each group of runs as a point, and its interval as a line.

    ``panels`` maps the title of each panel to the values drawn in it.
    """
    figure = _figure(5.2 * len(panels), 1.2 + 0.45 * max(len(bars) for bars in panels.values()))
    for axis, (title, bars) in zip(figure.subplots(1, len(panels), squeeze=False).flat, panels.items(), strict=True):
        for number, (_, value, interval) in enumerate(bars):
            colour = _colour(number)
            axis.plot(interval or (value, value), [number, number], linewidth=2.5, alpha=0.5, color=colour)
            axis.plot([value], [number], marker="o", color=colour)
        axis.set_yticks(range(len(bars)), ["\n".join(textwrap.wrap(_plain(label), 40)) for label, _, _ in bars])
        axis.set_ylim(len(bars) - 0.5, -0.5)
        axis.set_title(title)
        axis.grid(alpha=0.3, axis="x")
    return figure


def draw_bars(groups: Mapping[str, Sequence[Bar]], title: str) -> "Figure":
    """Draw horizontal bars, a colour for each group; bars with equal labels share a row, and lines mark intervals."""
    names = list(dict.fromkeys(label for label, _, _ in chain.from_iterable(groups.values())))
    height = 0.8 / len(groups)
    figure = _figure(6.4, 1.0 + 0.32 * len(names))
    axis = figure.subplots()
    for number, bars in enumerate(groups.values()):
        rows = [names.index(label) - 0.4 + (number + 0.5) * height for label, _, _ in bars]
        axis.barh(rows, [value for _, value, _ in bars], height, color=_colour(number))
        for row, (_, _, interval) in zip(rows, bars, strict=True):
            if interval:
                axis.plot(interval, (row, row), color="black", linewidth=1.0)
    axis.set_yticks(range(len(names)), [_plain(name) for name in names])
    axis.set_ylim(len(names) - 0.5, -0.5)
    axis.set_xlabel(title)
    axis.grid(alpha=0.3, axis="x")
    _add_legend(figure, list(groups))
    return figure


def draw_adaptation(evaluation: Evaluated, where: object, goal: int = 0) -> "Figure":
    """Draw return and success of every class against shots of adaptation, train classes first, then test classes.

    Bands are the 95 % bootstrap intervals over tasks (of few tasks: episodes). ``goal`` is the number of steps of the
    run; the title names it if the evaluation is of fewer steps. Raises BidexError if the evaluation is not a meta-test;
    ``where`` is its file, for the message.
    """
    if not isinstance(evaluation, MetaTestEvaluation):
        again = f"Write one: bidex-meta evaluate RUN --shots 3 --json > {where}"
        raise BidexError(f"{where} holds no meta-test: its learner does not adapt. {again}")
    splits = evaluation.splits
    figure, blocks = _task_panels([list(part.before.classes) for part in splits.values()])
    for (split, part), axes in zip(splits.items(), blocks, strict=True):
        for name, panels in zip(part.before.classes, axes, strict=True):
            rows = [shot.classes[name] for shot in part.by_shot]
            _draw_shots(panels, rows, _COLOURS.get(split))
            panels[0].set_title(_plain(f"{split}: {name}"), fontsize=10)
    if evaluation.steps is not None and evaluation.steps < goal:
        figure.suptitle(f"meta-test after {evaluation.steps:,} of {goal:,} steps")
    return figure


def _draw_shots(panels: "tuple[Axes, Axes]", rows: list[ClassSummary], colour: str | None) -> None:
    """Draw the return after each shot into the upper panel, and the success rate into the lower one."""
    upper, lower = panels
    _draw_band(upper, [row.mean_return for row in rows], [row.return_interval for row in rows], colour)
    _draw_band(lower, [row.success for row in rows], [row.success_interval for row in rows], colour)
    lower.set_ylim(-0.02, 1.02)
    lower.set_xlabel("shots")


def _draw_band(axis: "Axes", values: list[float], intervals: list[Interval | None], colour: str | None) -> None:
    shots = list(range(len(values)))
    axis.plot(shots, values, marker="o", markersize=3, linewidth=1.2, color=colour)
    if all(intervals):
        low, high = np.array(intervals).T
        axis.fill_between(shots, low, high, alpha=0.2, color=colour)
    axis.grid(alpha=0.3)
    axis.set_xticks(shots)


def _matplotlib() -> ModuleType:
    import_module("matplotlib.figure")
    return import_module("matplotlib")


def _figure(width: float, height: float) -> "Figure":
    """Return an empty figure, without matplotlib's global state."""
    return _matplotlib().figure.Figure(figsize=(width, height), layout="constrained")


def _task_panels(blocks: Sequence[Sequence[str]]) -> "tuple[Figure, list[list[tuple[Axes, Axes]]]]":
    """Return a figure with empty panels, and the panels of each name: one for the return and one below it for success.

    ``blocks`` are lists of names; each list begins in a new row of the figure.
    """
    columns = [min(_COLUMNS, len(names)) for names in blocks]
    heights = [-(-len(names) // width) for names, width in zip(blocks, columns, strict=True)]
    figure = _figure(3.2 * max(columns), 4.0 * sum(heights))
    axes = figure.subplots(2 * sum(heights), max(columns), squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    first = 0
    panels = []
    for names, width, height in zip(blocks, columns, heights, strict=True):
        spots = [(2 * (first + number // width), number % width) for number in range(len(names))]
        panels.append([(axes[row, column], axes[row + 1, column]) for row, column in spots])
        for pair, (_, column) in zip(panels[-1], spots, strict=True):
            for axis, measure in zip(pair, _MEASURES, strict=True):
                axis.set_axis_on()
                if column == 0:
                    axis.set_ylabel(measure)
        first += height
    return figure, panels


def save(figure: "Figure", out: Path, metadata: Mapping[str, str] | None = None) -> None:
    """Write a figure with ``metadata`` in the format of the file's suffix; raises BidexError for an unknown suffix."""
    known = figure.canvas.get_supported_filetypes()
    ending = out.suffix[1:].lower()
    if ending not in known:
        raise BidexError(f"Expected a picture's ending ({', '.join(sorted(known))}), got {out.name!r}. Name it .png.")
    out.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(out, lambda file: figure.savefig(file, format=ending, dpi=120, metadata=metadata))


def svg(figure: "Figure") -> bytes:
    """Return a figure as SVG, with words stored as text."""
    out = io.BytesIO()
    with _matplotlib().rc_context({"svg.fonttype": "none"}):
        figure.savefig(out, format="svg", metadata={"Date": None})
    return out.getvalue()


def _draw_curve(axis: "Axes", curve: Curve | None, label: str, number: int, style: str, unit: float = 1e6) -> None:
    if curve is None:
        return
    steps = curve.steps / unit
    colour = _colour(number)
    if len(steps) == 1 or (style != "-" and len(steps) <= _FEW):
        marker = "."
    else:
        marker = None
    axis.plot(steps, curve.mean, linewidth=1.2, color=colour, linestyle=style, marker=marker, label=_plain(label))
    if curve.low is not None and curve.high is not None:
        axis.fill_between(steps, curve.low, curve.high, alpha=0.2, color=colour, linewidth=0.0)


def _draw_groups(
    axis: "Axes", groups: Sequence[Group], tag: str, numbers: Sequence[int], unit: tuple[float, str]
) -> None:
    for (label, curves), number in zip(groups, numbers, strict=True):
        _draw_curve(axis, curves.get(tag), label, number, "-", unit[0])
    axis.grid(alpha=0.3)
    axis.set_xlabel(unit[1])


def _colour(number: int) -> tuple[float, float, float]:
    """Return the colour of a group: ten strong colours, then ten light colours, then the same again."""
    colours = _matplotlib().colormaps["tab20"].colors
    return (colours[0::2] + colours[1::2])[number % len(colours)]


def _add_legend(figure: "Figure", labels: Sequence[str]) -> None:
    lines = [_matplotlib().lines.Line2D([], [], color=_colour(number)) for number in range(len(labels))]
    inches = figure.get_size_inches()[0]
    words = ["\n".join(textwrap.wrap(_plain(label), max(20, int(12 * inches)))) for label in labels]
    columns = max(1, min(len(labels), int(12 * inches) // (max(map(len, labels)) + 9)))
    figure.legend(lines, words, loc="outside upper left", ncols=columns, frameon=False)


def _plain(name: str) -> str:
    """Return a user's name, escaped so that matplotlib does not take a dollar sign for a formula."""
    return name.replace("$", r"\$")

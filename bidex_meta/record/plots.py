"""Curves of a run as a PNG: of learning, from its ``metrics.jsonl``; of adaptation, from its ``evaluation.json``.

Needs the extra ``plot``.
"""

import json
from pathlib import Path
from typing import Any

from bidex_meta.errors import BidexError
from bidex_meta.record.metrics import read_metrics

_COLUMNS = 4
_PANELS = (("Train/return/", "return"), ("Train/success/", "success"))
_COLOURS = {"train": "tab:blue", "test": "tab:orange"}


def plot_learning_curves(metrics_path: Path, out: Path) -> None:
    """Draw return and success of every task against environment steps.

    Each task has its own panels: their returns differ by orders of magnitude.

    Args:
        metrics_path: A run's ``metrics.jsonl``.
        out: The picture to write; its ending names the format.

    Raises:
        BidexError: matplotlib is missing or does not know the ending, or no episode has been logged yet.
    """
    make_figure = _figure()
    rows = read_metrics(metrics_path)
    names = list(dict.fromkeys(tag[len(p) :] for row in rows for tag in row for p, _ in _PANELS if tag.startswith(p)))
    if not names:
        raise BidexError(f"{metrics_path} holds no finished episode yet: nothing to plot.")
    columns, blocks = _grid(len(names))
    figure = make_figure(figsize=(3.2 * columns, 4.0 * blocks), layout="constrained")
    axes = figure.subplots(2 * blocks, columns, squeeze=False)
    for place in range(blocks * columns):
        for panel, (prefix, label) in enumerate(_PANELS):
            axis = axes[2 * (place // columns) + panel, place % columns]
            if place >= len(names):
                axis.set_axis_off()
                continue
            steps, values = _series(rows, prefix + names[place])
            axis.plot([step / 1e6 for step in steps], values, linewidth=1.2)
            axis.grid(alpha=0.3)
            if panel == 0:
                axis.set_title(names[place])
            else:
                axis.set_ylim(-0.02, 1.02)
                axis.set_xlabel("environment steps (millions)")
            if place % columns == 0:
                axis.set_ylabel(label)
    _save(figure, out)


def plot_adaptation(evaluation_path: Path, out: Path) -> None:
    """Draw return and success of every class against shots of adaptation, train classes first, then test classes.

    Bands are the 95 % bootstrap intervals over episodes.

    Args:
        evaluation_path: A run's ``evaluation.json``, or what ``bidex-meta evaluate RUN --shots K --json`` prints.
        out: The picture to write; its ending names the format.

    Raises:
        BidexError: matplotlib is missing or does not know the ending, or the file holds no meta-test.
    """
    make_figure = _figure()
    again = f"Write one: bidex-meta evaluate RUN --shots 3 --json > {evaluation_path}"
    if not evaluation_path.is_file():
        raise BidexError(f"There is no {evaluation_path}. {again}")
    try:
        found = json.loads(evaluation_path.read_text())
    except ValueError:
        raise BidexError(f"{evaluation_path} is not JSON. {again}") from None
    splits = found.get("splits") if isinstance(found, dict) else None
    if not splits:
        raise BidexError(f"{evaluation_path} holds no meta-test: its learner does not adapt, or it is older. {again}")
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
            axes[row, place % grids[split][0]].set_title(f"{split}: {name}", fontsize=10)
        first += grids[split][1]
    _save(figure, out)


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


def _figure() -> Any:
    """Matplotlib's class of figures, without its global state."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise BidexError("Plots need matplotlib: pip install 'bidex-meta[plot]'.") from None
    return Figure


def _save(figure: Any, out: Path) -> None:
    known = figure.canvas.get_supported_filetypes()
    if out.suffix[1:].lower() not in known:
        raise BidexError(f"Expected a picture's ending ({', '.join(sorted(known))}), got {out.name!r}. Name it .png.")
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=120)


def _grid(panels: int) -> tuple[int, int]:
    """Columns, and blocks of two rows, for so many tasks."""
    columns = min(_COLUMNS, panels)
    return columns, -(-panels // columns)


def _series(rows: list[dict[str, Any]], tag: str) -> tuple[list[int], list[float]]:
    points = [(row["step"], row[tag]) for row in rows if row.get(tag) is not None]
    return [step for step, _ in points], [value for _, value in points]

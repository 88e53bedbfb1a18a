"""Learning curves of a run, from its ``metrics.jsonl`` to a PNG. Needs the extra ``plot``."""

from pathlib import Path
from typing import Any

from bidex_meta.errors import BidexError
from bidex_meta.record.metrics import read_metrics

_COLUMNS = 4
_PANELS = (("Train/return/", "return"), ("Train/success/", "success"))


def plot_learning_curves(metrics_path: Path, out: Path) -> None:
    """Draw return and success of every task against environment steps.

    Each task has its own panels: their returns differ by orders of magnitude.

    Args:
        metrics_path: A run's ``metrics.jsonl``.
        out: The picture to write; its ending names the format.

    Raises:
        BidexError: matplotlib is missing, or no episode has been logged yet.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise BidexError("Plots need matplotlib: pip install 'bidex-meta[plot]'.") from None
    rows = read_metrics(metrics_path)
    names = list(dict.fromkeys(tag[len(p) :] for row in rows for tag in row for p, _ in _PANELS if tag.startswith(p)))
    if not names:
        raise BidexError(f"{metrics_path} holds no finished episode yet: nothing to plot.")
    columns = min(_COLUMNS, len(names))
    blocks = -(-len(names) // columns)
    figure = Figure(figsize=(3.2 * columns, 4.0 * blocks), layout="constrained")
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
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=120)


def _series(rows: list[dict[str, Any]], tag: str) -> tuple[list[int], list[float]]:
    points = [(row["step"], row[tag]) for row in rows if row.get(tag) is not None]
    return [step for step, _ in points], [value for _, value in points]

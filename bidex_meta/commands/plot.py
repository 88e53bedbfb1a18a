"""``bidex-meta plot``: learning curves."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidex_meta.commands.parsing import RunPath, parse


@dataclass(frozen=True)
class PlotFlags:
    """Return and success of every task against environment steps, as a picture.

    Example: bidex-meta plot runs/MT4/mtppo/2026-11-21_10-00-00_seed0 --out curves.png
    """

    run: RunPath
    """Run folder."""
    out: Path | None = None
    """The picture; None: curves.png in the run folder."""


def main(arguments: Sequence[str]) -> None:
    """Draw the curves and print where they are."""
    flags = parse(PlotFlags, arguments, "plot")

    from bidex_meta.record import RunFolder
    from bidex_meta.record.plots import plot_learning_curves

    folder = RunFolder.open(flags.run)
    out = flags.out or folder.path / "curves.png"
    plot_learning_curves(folder.metrics_path, out)
    print(out)

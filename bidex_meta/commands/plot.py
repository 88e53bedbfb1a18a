"""``bidex-meta plot``: learning curves."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidex_meta.commands.parsing import RunPath, Switch, parse


@dataclass(frozen=True)
class PlotFlags:
    """Return and success of every task against environment steps, or against shots of adaptation, as a picture.

    Example: bidex-meta plot runs/MT4/mtppo/2026-11-21_10-00-00_seed0 --out curves.png
    """

    run: RunPath
    """Run folder."""
    adaptation: Switch = False
    """Against shots of adaptation, from the meta-test in the run's evaluation.json."""
    evaluation: Path | None = None
    """The output of another `bidex-meta evaluate RUN --shots K --json`, instead of the run's evaluation.json."""
    out: Path | None = None
    """The picture; None: curves.png or adaptation.png in the run folder."""


def main(arguments: Sequence[str]) -> None:
    """Draw the curves and print where they are."""
    flags = parse(PlotFlags, arguments, "plot")

    from bidex_meta.record import RunFolder
    from bidex_meta.record.plots import plot_adaptation, plot_learning_curves

    folder = RunFolder.open(flags.run)
    if flags.adaptation or flags.evaluation:
        out = flags.out or folder.path / "adaptation.png"
        plot_adaptation(flags.evaluation or folder.path / "evaluation.json", out)
        print(out)
        return
    out = flags.out or folder.path / "curves.png"
    plot_learning_curves(folder.metrics_path, out)
    print(out)

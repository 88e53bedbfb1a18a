"""``bidex-meta plot``: learning curves."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from bidex_meta.commands.parsing import Switch, parse
from bidex_meta.errors import BidexError


@dataclass(frozen=True)
class PlotFlags:
    """Return and success of every task against environment steps, or against shots of adaptation, as a picture.

    Example: bidex-meta plot runs/MT4/mtppo/* --out curves.png

    Runs that differ in the seed alone are one line, with the 95 % bootstrap interval over runs.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN...")]
    """Run folders, or files of results/data/."""
    adaptation: Switch = False
    """Against shots of adaptation, from the meta-test in the run's evaluation.json; of one run."""
    evaluation: Path | None = None
    """The output of another `bidex-meta evaluate RUN --shots K --json`, instead of the run's evaluation.json."""
    out: Path | None = None
    """The picture; None: curves.png or adaptation.png, in the run folder or, of several, here."""


def main(arguments: Sequence[str]) -> None:
    """Draw the curves and print where they are.

    Raises:
        BidexError: No run is named, or there is nothing to draw.
    """
    flags = parse(PlotFlags, arguments, "plot")
    if not flags.runs:
        raise BidexError("Name the run folders to draw: bidex-meta plot RUN...")

    from bidex_meta.record import plots
    from bidex_meta.record.atomic import check_writable, refuse_links
    from bidex_meta.record.stored import StoredRun, open_run

    runs = [open_run(path) for path in flags.runs]
    home = runs[0].path if len(runs) == 1 and runs[0].path.is_dir() else Path()
    if flags.out is None:
        refuse_links(home / "curves.png", home / "adaptation.png")
    else:
        check_writable(flags.out)
    if flags.adaptation or flags.evaluation:
        if len(runs) > 1:
            raise BidexError(f"--adaptation draws one run, got {len(runs)}. bidex-meta report shows all.")
        out, source = flags.out or home / "adaptation.png", flags.evaluation or home / "evaluation.json"
        if isinstance(runs[0], StoredRun) and flags.evaluation is None:
            figure = plots.draw_adaptation(runs[0].evaluation(), runs[0].path)
        else:
            figure = plots.draw_adaptation(plots.read_evaluation(source), source)
    else:
        from bidex_meta.evaluation.comparison import read_histories

        out = flags.out or home / "curves.png"
        figure = plots.draw_learning([(history.label, history.curves) for history in read_histories(runs)])
    plots.save(figure, out)
    print(out)

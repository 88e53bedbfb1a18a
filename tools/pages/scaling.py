"""Results for each learner and number of parallel environments, at equal environment steps (the paper's Figure 6)."""

from collections.abc import Iterator, Sequence
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.comparison import curves_of
from bidex_meta.runs import plots
from bidex_meta.runs.stored import StoredRun
from tools.pages.studies import Study, refuse_differing
from tools.pages.tables import mean_and_range, random_rows, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def rows_table(study: Study) -> Iterator[str]:
    """Yield a table of evaluated returns with a row per number of environments and a column per learner.

    A cell shows the mean over seeds, followed in brackets by the lowest and the highest value of a seed. Raises
    BidexError if the runs of one cell differ in more than the seed, or if the runs are on several classes.
    """
    cells = _cells(study)
    algos = list(dict.fromkeys(algo for algo, _ in cells))
    counts = sorted({envs for _, envs in cells})
    rows = [[f"{envs:,}", *(_cell(cells.get((algo, envs), [])) for algo in algos)] for envs in counts]
    yield from table(["environments", *algos], rows)
    steps = sorted({run.content["steps"] for run in study.runs})
    seeds = sorted({len(runs) for runs in cells.values()})
    yield ""
    returns = [row.mean_return for row in chain.from_iterable(random_rows(study).values())]
    random = f"Uniform actions: {np.mean(returns):.4g}." if returns else ""
    yield f"Seeds: {_range(seeds)}. Steps: {_range(steps)}. {random}"


def rows_figure(study: Study) -> "Figure":
    """Draw the return over training: one panel per learner, one line per number of environments."""
    panels: dict[str, list[plots.Group]] = {}
    for (algo, envs), runs in sorted(_cells(study).items()):
        panels.setdefault(algo, []).append((f"{envs} envs", curves_of(runs)))
    return plots.draw_panels(panels, f"Train/return/{_class(study)}", "return in training")


def _cells(study: Study) -> dict[tuple[str, int], list[StoredRun]]:
    """Group runs by learner and number of environments."""
    cells: dict[tuple[str, int], list[StoredRun]] = {}
    for run in study.runs:
        config = run.config()
        cells.setdefault((config.algo, config.num_envs), []).append(run)
    for (algo, envs), runs in cells.items():
        refuse_differing(f"{algo} with {envs} environments", runs)
    _class(study)
    return cells


def _class(study: Study) -> str:
    names = set[str]().union(*(run.evaluation().results for run in study.runs))
    if len(names) != 1:
        raise BidexError(
            f"Study {study.name}: numbers of environments are compared on one class, got {', '.join(sorted(names))}."
        )
    return names.pop()


def _cell(runs: Sequence[StoredRun]) -> str:
    if not runs:
        return "–"
    returns = []
    for run in runs:
        returns += [row.mean_return for row in run.evaluation().results.values()]
    return mean_and_range(np.array(returns))


def _range(numbers: Sequence[int]) -> str:
    return f"{numbers[0]:,}" if len(numbers) == 1 else f"{numbers[0]:,} to {numbers[-1]:,}"

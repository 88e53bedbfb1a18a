"""Table of offline learners' scores: a row per kind of data, a column per learner.

The score is the paper's (appendix A.3): 100 (R - R_random) / (R_expert - R_random), with returns from the study's own
evaluations. The expert is the study's online run on the same class. If there is no such run (suites have none), the
table shows the scores that the evaluations contain.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain

import numpy as np

from bidex_meta.evaluation.comparison import scored_classes
from bidex_meta.runs.evaluations import ClassSummary
from bidex_meta.runs.stored import StoredRun
from tools.pages.studies import Study, classes_of_random, refuse_differing
from tools.pages.tables import mean_and_range, table

KINDS = ("random", "replay", "medium", "medium-expert", "expert")
"""Order of the rows, as in the paper's table; other kinds of data follow in alphabetical order."""
LEARNERS = ("bc", "bcq", "td3bc", "iql")
"""Order of the columns."""


def offline_table(study: Study) -> Iterator[str]:
    """Yield a table with a row per kind of data and a column per learner.

    A cell shows the mean score over seeds, the lowest and the highest score of a seed in brackets, and the mean
    success. The study's online runs are the experts. Raises BidexError if the runs of one cell differ in more than the
    seed.
    """
    cells: dict[str, dict[str, list[StoredRun]]] = {}
    experts = []
    for run in study.runs:
        config = run.config()
        if config.dataset:
            cells.setdefault(_kind(config.dataset), {}).setdefault(config.algo, []).append(run)
        else:
            experts.append(run)
    learners = _ordered(set().union(*cells.values()), LEARNERS)
    ends = _ends(study.runs, experts)
    rows = []
    for kind in _ordered(cells, KINDS):
        rows.append([kind, *(_cell(cells[kind].get(algo, []), ends) for algo in learners)])
    yield from table(["data", *learners], rows)
    seeds = sorted(set(map(len, chain.from_iterable(row.values() for row in cells.values()))))
    updates = []
    for algo in learners:
        runs = chain.from_iterable(row.get(algo, []) for row in cells.values())
        updates.append(f"{algo} {_listed(sorted({run.content['steps'] for run in runs}))}")
    yield ""
    yield f"Seeds: {_listed(seeds)}. Updates: {'; '.join(updates)}."
    if ends is not None:
        success = f"{100 * _mean(experts, 'success'):.3g} %"
        yield f"Returns: expert {ends[1]:.4g} (success {success}), uniform actions {ends[0]:.4g}."


def _kind(names: Sequence[str]) -> str:
    """Return the kind of data of a run: ``medium`` for ``HandOver/medium-v0``."""
    return " + ".join(name.rpartition("/")[2].rpartition("-v")[0] or name for name in names)


def _ends(runs: Sequence[StoredRun], experts: Sequence[StoredRun]) -> tuple[float, float] | None:
    """Return the mean returns of uniform actions and of the experts; None if either is missing."""
    random = [rows for rows in map(classes_of_random, runs) if rows]
    if not experts or not random:
        return None
    return float(np.mean([_mean_of(rows, "mean_return") for rows in random])), _mean(experts, "mean_return")


def _cell(runs: Sequence[StoredRun], ends: tuple[float, float] | None) -> str:
    if not runs:
        return "–"
    refuse_differing(f"{_kind(runs[0].config().dataset)} {runs[0].config().algo}", runs)
    if ends is None:
        scores = np.array([_mean_of(scored_classes(run), "score") for run in runs])
    else:
        returns = np.array([_mean_of(run.evaluation().results, "mean_return") for run in runs])
        scores = 100 * (returns - ends[0]) / (ends[1] - ends[0])
    return f"{mean_and_range(scores, '.1f')}; {100 * _mean(runs, 'success'):.3g} %"


def _mean(runs: Sequence[StoredRun], name: str) -> float:
    return float(np.mean([_mean_of(run.evaluation().results, name) for run in runs]))


def _mean_of(classes: Mapping[str, ClassSummary], name: str) -> float:
    """Return the mean of a measure over classes; NaN if a class has no value."""
    return float(np.mean(np.array([getattr(row, name) for row in classes.values()], dtype=float)))


def _ordered(names: Iterable[str], known: Sequence[str]) -> list[str]:
    return sorted(names, key=lambda name: (known.index(name) if name in known else len(known), name))


def _listed(numbers: Sequence[int]) -> str:
    return " or ".join(f"{number:,}" for number in numbers)

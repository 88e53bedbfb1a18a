"""``python -m tools.experts RUN...``: find the best policy that solves each class of version 1; its score is 100."""

from collections.abc import Collection, Sequence
from itertools import chain
from pathlib import Path

import tyro

import tools
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.references import Kind, load, store
from bidex_meta.rules import V1
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.evaluations import PolicyEvaluation
from bidex_meta.runs.stored import Run, open_runs
from bidex_meta.runs.versions import collect_versions
from bidex_meta.worlds import open_worlds
from tools.standard import check_standard

_SOLVES = 0.5
"""Smallest success over all tasks of a class for which a policy counts as an expert."""


def experts(runs: tyro.conf.Positional[tuple[Path, ...]], suite: str = "MT20", out: Path | None = None) -> None:
    """Find the best policy that solves each class, and print and store its return and its source.

    Candidates are the class's witness (a stored episode that solves a task), the class's script and the given runs.

    Example: python -m tools.experts results/data/experts.json --out assets/references/expert.json

    Args:
        runs: Runs on single classes, as folders or files of results/data. Leave out runs on suites, because scores
            compare them with the policies found here.
        suite: Suite whose train classes are looked up.
        out: File of references, which is overwritten.

    Raises:
        BidexError: The suite is not of version 1, or a run cannot be compared (see :func:`best_known`).
    """
    worlds = open_worlds({"suite": suite})
    if worlds.rules != V1:
        raise BidexError(f"Expected a suite of version 1, got {suite}. Scores of version 2 need no experts.")
    known = best_known(worlds.task_classes(), runs)
    for name, row in known.items():
        print(f"{name}: {row['return']:.4g} ({row['source']})")
    if out is not None:
        out.unlink(missing_ok=True)
        store(out, known, {"versions": collect_versions()})


def best_known(names: Collection[str], runs: Sequence[Path]) -> dict[str, Json]:
    """Find return and source of the best policy of each class among those that solve at least half of the tasks.

    A class without such a policy is left out. ``runs`` are folders of evaluated runs, or entries that ``collect`` has
    stored. Raises BidexError if a run has no evaluation on train tasks without randomisation, plays a class with fixed
    bases, or plays by other rules than those of version 1.
    """
    candidates: list[tuple[str, Json]] = []
    for run in chain.from_iterable(map(open_runs, runs)):
        candidates += _of_run(run)
    played: tuple[Kind, ...] = ("script", "witness")
    for kind in played:
        candidates += [(name, row | {"source": kind}) for name, row in load(kind).items()]
    best: dict[str, Json] = {}
    for name, row in candidates:
        solves = name in names and row["success"] >= _SOLVES
        if solves and row["return"] > best.get(name, {"return": -float("inf")})["return"]:
            best[name] = {key: row[key] for key in ("return", "success", "source")}
    return best


def _of_run(run: Run) -> list[tuple[str, Json]]:
    """Return the results of a run's classes from its evaluation, as means over all tasks."""
    config = run.config()
    source = open_worlds(config.to_json())
    if not source.moving_bases:
        raise BidexError(
            f"Expected a run with moving bases, as in suites, but {run.path} plays {source.name} with fixed ones."
        )
    if source.rules != V1:
        raise BidexError(
            f"Expected a run by the rules of version 1, but {run.path} plays {source.name} by other rules. Leave it "
            "out, because its returns cannot be compared."
        )
    evaluation = run.evaluation()
    check_standard(run, evaluation)
    if not isinstance(evaluation, PolicyEvaluation):
        raise BidexError(
            f"Expected the evaluation of one policy, but that of {run.path} is a meta-test. Name a run of "
            "mtppo, mttrpo or mtsac."
        )
    # A limit of time, return or score may have ended the run before the steps of its config.
    steps = config.steps if evaluation.steps is None else evaluation.steps
    told = f"{config.algo} on {source.name}, {steps:,} steps, seed {config.seed}"
    rows = []
    for name, row in evaluation.policy.classes.items():
        rows.append((name, {"return": row.mean_return, "success": row.success, "source": told}))
    return rows


if __name__ == "__main__":
    tools.run(experts)

"""``python -m tools.experts RUN...``: find the best policy that solves each class; its normalised score is 100."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import tyro

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.references import Kind, load, store
from bidex_meta.runs.evaluations import PolicyEvaluation
from bidex_meta.runs.stored import Run, open_runs
from bidex_meta.runs.versions import collect_versions
from bidex_meta.worlds import Worlds

_SOLVES = 0.5
"""Success over all tasks of a class that an expert must have."""


def experts(runs: tyro.conf.Positional[tuple[Path, ...]], suite: str = "MT20", out: Path | None = None) -> None:
    """Print and store, for each class, the best of its witness, its script and the runs, if the best solves the class.

    Example: python -m tools.experts results/data/experts.json --out assets/references/expert.json

    Args:
        runs: Runs of single classes, folders or files of results/data: a suite's policy is judged by these scores.
        suite: Suite whose train classes are looked up.
        out: File of references, written anew.
    """
    known = best_known(Worlds.open({"suite": suite}).task_classes(), runs)
    for name, row in known.items():
        print(f"{name}: {row['return']:.4g} ({row['source']})")
    if out is not None:
        out.unlink(missing_ok=True)
        store(out, known, {"versions": collect_versions()})


def best_known(names: Collection[str], runs: Sequence[Path]) -> dict[str, dict[str, Any]]:
    """Find return and source of the best policy of each class among those that solve at least half of the tasks.

    A class without such a policy is left out.

    Args:
        names: The classes.
        runs: Evaluated runs: their folders, or their entries that ``collect`` has stored.

    Raises:
        BidexError: A run has no evaluation, or plays a class with fixed bases.
    """
    candidates = [row for path in runs for run in open_runs(path) for row in _of_run(run)]
    played: tuple[Kind, ...] = ("script", "witness")
    candidates += [(name, row | {"source": kind}) for kind in played for name, row in load(kind).items()]
    best: dict[str, dict[str, Any]] = {}
    for name, row in candidates:
        solves = name in names and row["success"] >= _SOLVES
        if solves and row["return"] > best.get(name, {"return": -float("inf")})["return"]:
            best[name] = {key: row[key] for key in ("return", "success", "source")}
    return best


def _of_run(run: Run) -> list[tuple[str, dict[str, Any]]]:
    """Return the results of a run's classes from its evaluation, as means over all tasks."""
    config = run.config()
    source = Worlds.open(config.to_json())
    if not source.moving_bases:
        raise BidexError(
            f"Expected a run with moving bases, as in suites, but {run.path} plays {source.name} with fixed ones."
        )
    evaluation = run.evaluation()
    if not isinstance(evaluation, PolicyEvaluation):
        raise BidexError(
            f"Expected the evaluation of one policy, but that of {run.path} is a meta-test. Name a run of "
            "mtppo, mttrpo or mtsac."
        )
    # Time, a return or a score may have ended the run before the steps of its config.
    steps = config.steps if evaluation.steps is None else evaluation.steps
    told = f"{config.algo} on {source.name}, {steps:,} steps, seed {config.seed}"
    rows = []
    for name, row in evaluation.policy.classes.items():
        rows.append((name, {"return": row.mean_return, "success": row.success, "source": told}))
    return rows


if __name__ == "__main__":
    tyro.cli(experts)

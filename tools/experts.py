"""``python -m tools.experts RUN...``: the best policy known of each class, the 100 of the normalised score."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import tyro

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.references import load, store
from bidex_meta.runs.stored import open_run
from bidex_meta.runs.versions import collect_versions
from bidex_meta.witness.replay import replay
from bidex_meta.witness.store import load_witness, witness_path
from bidex_meta.worlds import Worlds


def experts(runs: tyro.conf.Positional[tuple[Path, ...]], suite: str = "MT20", out: Path | None = None) -> None:
    """Print, and store, per class the best of its witness, its script and the given runs.

    Example: python -m tools.experts results/data/experts/*.json --out assets/references/expert.json

    Args:
        runs: Run folders, or files of results/data/.
        suite: Suite whose train classes are looked up.
        out: File of references that takes the figures, beside those it has of other classes.
    """
    known = best_known(Worlds.open({"suite": suite}).task_classes(), runs)
    for name, row in known.items():
        print(f"{name}: {row['return']:.4g} ({row['source']})")
    if out is not None:
        store(out, known, {"versions": collect_versions()})


def best_known(names: Collection[str], runs: Sequence[Path]) -> dict[str, dict[str, Any]]:
    """Return and source of the best policy of each class; a class of which nothing is known is left out.

    Args:
        names: The classes.
        runs: Evaluated runs: their folders, or what ``collect`` has kept of them.

    Raises:
        BidexError: A run has no evaluation, or plays a class with fixed bases.
    """
    candidates = [row for run in runs for row in _of_run(run)]
    candidates += [(name, {"return": row["return"], "source": "script"}) for name, row in load("script").items()]
    candidates += [row for name in names for row in _of_witness(name)]
    best: dict[str, dict[str, Any]] = {}
    for name, row in candidates:
        if name in names and row["return"] > best.get(name, {"return": -float("inf")})["return"]:
            best[name] = row
    return best


def _of_witness(name: str) -> list[tuple[str, dict[str, Any]]]:
    """A witness that holds: one episode of one task."""
    if not witness_path(name).is_file():
        return []
    played = replay(name, load_witness(name))
    return [(name, {"return": played.total, "source": "witness, task 0"})] if played.found else []


def _of_run(path: Path) -> list[tuple[str, dict[str, Any]]]:
    """What a run's evaluation says of its classes: the mean over all tasks."""
    run = open_run(path)
    config = run.config()
    source = Worlds.open(config.to_json())
    if not source.moving_bases:
        raise BidexError(
            f"Expected a run with moving bases, as suites have them, but {path} plays {source.name} with fixed ones."
        )
    found = run.evaluation()
    if "policy" not in found:
        raise BidexError(
            f"Expected the evaluation of a policy, but that of {path} is a meta-test, whose policies are many. Name a "
            "run of mtppo, mttrpo or mtsac."
        )
    classes = found["policy"]["classes"]
    steps = found.get("steps", config.steps)  # of what time, a return or a score has ended fewer than were asked for
    told = f"{config.algo} on {source.name}, {steps:,} steps, seed {config.seed}"
    return [(name, {"return": row["return"], "source": told}) for name, row in classes.items()]


if __name__ == "__main__":
    tyro.cli(experts)

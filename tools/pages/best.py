"""The best run of each class, beside its witness and its script: what a study of single classes found as experts."""

from collections.abc import Iterator, Sequence
from typing import Any

from bidex_meta.evaluation.comparison import scored_classes
from bidex_meta.evaluation.references import load
from bidex_meta.record.stored import StoredRun
from bidex_meta.tasks import registry
from tools.pages.studies import Study, head_of, row_of

_OF_RUN = ("arm", "seed", "steps", "hours")
"""Columns that tell which of several runs a row is of."""
_FOUND = ("success [95 %]", "return [95 %]", "score", "uniform actions", "witness, open loop", "script")


def best_table(studies: Sequence[Study]) -> Iterator[str]:
    """Lines of Markdown: a class a row, of its runs the one that succeeds most often; of equals the largest return.

    Classes stand in MT20's order. Where there is one run of all classes, no row says which.

    Args:
        studies: One for each class or set of classes.
    """
    rows: dict[str, list[tuple[StoredRun, dict[str, Any]]]] = {}
    for study in studies:
        for run in study.runs:
            for name, row in scored_classes(run).items():
                rows.setdefault(name, []).append((run, row))
    untaught, many = [load("witness"), load("script")], sum(len(study.runs) for study in studies) > 1
    yield from head_of(["class", *_OF_RUN, *_FOUND, "runs"] if many else ["class", *_FOUND])
    place = {name: number for number, name in enumerate(registry.names())}
    for name, found in sorted(rows.items(), key=lambda row: place.get(row[0], len(place))):
        run, best = max(found, key=lambda each: (each[1]["success"], each[1]["return"]))
        random = run.evaluation().get("random", {"classes": {}})["classes"].get(name)
        cells = [
            _ranged(best, "success", 100.0, " %"),
            _ranged(best, "return"),
            "–" if best["score"] is None else f"{best['score']:.0f}",
            "–" if random is None else f"{random['return']:.4g}",
            *(f"{100 * known[name]['success']:.4g} %" if name in known else "–" for known in untaught),
        ]
        yield row_of([name, *_which(run), *cells, str(len(found))] if many else [name, *cells])


def _which(run: StoredRun) -> list[str]:
    content = run.content
    return [run.arm, str(run.config()["seed"]), f"{content['steps']:,}", f"{content['seconds'] / 3600:.2f}"]


def _ranged(row: dict[str, Any], measure: str, factor: float = 1.0, unit: str = "") -> str:
    told, interval = f"{factor * row[measure]:.4g}{unit}", row.get(f"{measure}_interval")
    return told if interval is None else f"{told} [{', '.join(f'{factor * end:.4g}' for end in interval)}]"

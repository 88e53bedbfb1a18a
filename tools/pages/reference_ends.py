"""``assets/references/`` as a table: what policies get that nobody trained, and the best that is known."""

from collections.abc import Iterator

from bidex_meta.evaluation.references import Kind, load
from bidex_meta.tasks import registry
from tools.pages.studies import head_of, row_of

_PLAYED: dict[Kind, str] = {"random": "random", "zero": "zero", "witness": "witness, open loop", "script": "script"}


def references_table() -> Iterator[str]:
    """Lines of Markdown: a class a row; return and success of each, of the expert its return and what it is."""
    played, expert = [load(kind) for kind in _PLAYED], load("expert")
    untaught = [f"{who}: {what}" for who in _PLAYED.values() for what in ("return", "success")]
    yield from head_of(["class", *untaught, "expert: return", "which"])
    for name in registry.names():
        cells = [name]
        for known in played:
            row = known.get(name)
            cells += ["–", "–"] if row is None else [f"{row['return']:.4g}", f"{100 * row['success']:.1f} %"]
        best = expert.get(name)
        yield row_of([*cells, *(["–", "–"] if best is None else [f"{best['return']:.4g}", best["source"]])])

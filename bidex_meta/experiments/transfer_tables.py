"""Tables of how much a policy helps on unseen classes, from the rows of ``transfer.json``."""

from collections.abc import Sequence

from bidex_meta.evaluation.statistics import NONE, Estimate
from bidex_meta.runs.atomic import Json


def reinforcement_table(rows: Sequence[Json], end: int) -> tuple[list[str], list[list[str]]]:
    """Return columns and rows of a table of runs that trained by reinforcement learning for ``end`` steps."""
    columns = [*(f"at {int(at):,} (%)" for at in rows[0]["at"]), "at the end (%)", "return", "area (%)"]
    table = []
    for row in rows:
        median = row["half"]["median"]
        seeds = row["half"]["of_seeds"]
        half = f"> {end:,}" if median is None else f"{median:,}"
        reached = sum(steps is not None for steps in seeds)
        measures = [*map(_text, (*row["at"].values(), row["success"])), _text(row["return"], 1.0), _text(row["area"])]
        measures += [_text(row["over_nothing"], form="+.1f"), f"{half} ({reached} of {len(seeds)})"]
        table.append([*_start(row), *measures])
    return ["class", "from", "seeds", *columns, "area over nothing", "steps to 50 %"], table


def demonstrations_table(rows: Sequence[Json]) -> tuple[list[str], list[list[str]]]:
    """Return columns and rows of a table of runs that learned from demonstrations."""
    table = []
    for row in rows:
        measures = [_text(row["success"]), _text(row["return"], 1.0), _text(row["over_nothing"], form="+.1f")]
        table.append([*_start(row), str(row["demonstrations"]), *measures])
    return ["class", "from", "seeds", "demonstrations", "success (%)", "return", "success over nothing"], table


def _start(row: Json) -> list[str]:
    return [row["class"], row["from"], ", ".join(map(str, row["seeds"]))]


def _text(estimate: Json | None, factor: float = 100.0, form: str = ".1f") -> str:
    if estimate is None:
        return NONE
    return Estimate(estimate["value"], estimate["interval"]).text(factor, form=form)

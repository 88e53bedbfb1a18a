"""Tables of what ``make gpu-quarter`` has measured."""

import json
from collections.abc import Iterator
from pathlib import Path

from bidex_meta.runs.atomic import Json
from tools.pages.tables import table

_MISSING = "not measured yet"


def gpu_table(show: str, data: Path) -> list[str]:
    """Return the table ``switches``, ``pictures`` or ``training`` from ``gpu-quarter.json`` next to ``data``."""
    file = data.parent / "gpu-quarter.json"
    found: Json = {}
    if file.is_file():
        found = json.loads(file.read_text()).get(show) or {}
    head = _HEADS[show]
    rows = list(_ROWS[show](found)) or [[_MISSING, *[""] * (len(head) - 1)]]
    return list(table(head, rows))


_HEADS = {
    "switches": [
        "environments",
        "switch",
        "env-steps/s",
        "relative to none",
        "with MT-PPO learning",
        "two plays are equal",
    ],
    "pictures": ["suite", "goals", "edge, pixels", "environments", "pictures/s", "env-steps/s with pictures"],
    "training": [
        "run",
        "suite",
        "learner, preset",
        "environments",
        "steps",
        "seconds",
        "first episode",
        "last episode",
    ],
}


def _switches(found: Json) -> Iterator[list[str]]:
    for size, row in found.get("rows", {}).items():
        for name, cell in row.items():
            if "error" in cell:
                yield [f"{int(size):,}", name, cell["error"], "", "", ""]
                continue
            speeds = [f"{cell['env_steps_per_s']:,}", f"{cell['ratio']:.2f}", f"{cell['training_steps_per_s']:,}"]
            yield [f"{int(size):,}", name, *speeds, "yes" if cell["repeats"] else "no"]


def _pictures(found: Json) -> Iterator[list[str]]:
    for row in found.get("rows", {}).values():
        counts = [found["setting"]["num_envs"], row["pictures_per_s"], row["env_steps_per_s"]]
        yield [row["suite"], row["goals"], str(row["pixels"]), *(f"{count:,}" for count in counts)]


def _training(found: Json) -> Iterator[list[str]]:
    for name, run in found.items():
        learner = f"{run['algo']}, {run['preset']}"
        counts = [f"{run['num_envs']:,}", f"{run['steps']:,}", f"{run['seconds']:.0f}"]
        yield [name, run["suite"], learner, *counts, _success(run, "first"), _success(run, "last")]


def _success(run: Json, which: str) -> str:
    share = run.get(f"Train/success_{which}_episode", run.get("Train/success_rate"))
    return "–" if share is None else f"{100 * share:.1f} %"


_ROWS = {"switches": _switches, "pictures": _pictures, "training": _training}

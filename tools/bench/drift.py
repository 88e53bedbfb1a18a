"""What the samples of a soak say: does memory grow, does speed fall beyond its noise?"""

from typing import Any

import numpy as np

MOST_GROWTH = 2.0
"""Memory may grow by so many per cent after the warm-up."""
_WARM_UP = 0.1
"""Share of the samples that is left out: rows are not yet spread over their episodes, allocators fill their pools."""


def judge(table: list[dict[str, Any]], speed: str) -> dict[str, Any]:
    """What the samples say, those of the warm-up (the first tenth, at least one) left out.

    Args:
        table: Samples as ``soak`` takes them, at least one.
        speed: The column that decides: of the CPU's time, which other processes disturb less, or of the wall's.
    """
    kept = table[max(1, round(_WARM_UP * len(table))) :] or table
    memory = [row["memory_mb"] for row in kept]
    growth = None if None in memory else 100.0 * (memory[-1] / memory[0] - 1.0)
    drifts = {name: _drift(kept, name) for name in ("steps_per_s", "steps_per_cpu_s")}
    drift = drifts[speed]
    small = growth is None or growth < MOST_GROWTH
    steady = drift["drift_interval"] is None or drift["drift_interval"][1] >= 0.0
    told = "memory is not told here" if growth is None else f"memory {growth:+.2f} % ({memory[-1]:.0f} MB)"
    how = "too few samples for a drift" if drift["drift_interval"] is None else _told(drift)
    broken = f"{table[-1]['unstable']} unstable rows, {table[-1]['unstable_per_million']:g} per million steps"
    verdict = "holds" if small and steady else "does not hold"
    return {
        "env_steps": table[-1]["env_steps"],
        "minutes": table[-1]["minute"],
        "warm_up_minutes": kept[0]["minute"],
        "unstable_per_million": table[-1]["unstable_per_million"],
        "memory_growth_percent": None if growth is None else round(growth, 3),
        **drifts,
        "holds": small and steady,
        "verdict": f"{verdict}: {told} after the warm-up; {speed} {how}; {broken}",
    }


def _told(drift: dict[str, Any]) -> str:
    low, high = drift["drift_interval"]
    return (
        f"{drift['mean']:,.0f}, drift {drift['drift_percent']:+.2f} % [{low:+.2f}, {high:+.2f}], "
        f"noise {drift['noise_percent']:.2f} %"
    )


def _drift(table: list[dict[str, Any]], name: str) -> dict[str, Any]:
    """The straight line through a column, over the whole of the table, in per cent of its mean."""
    values, minutes = (np.array([row[key] for row in table], dtype=float) for key in (name, "minute"))
    found: dict[str, Any] = {"mean": round(float(values.mean()), 1), "drift_percent": None, "drift_interval": None}
    if len(values) < 5 or np.ptp(minutes) == 0:
        return found | {"noise_percent": None}
    from scipy.stats import t

    centred = minutes - minutes.mean()
    slope = float(centred @ values / (centred @ centred))
    rest = values - values.mean() - slope * centred
    # Neighbouring minutes are alike on a machine that others use too: they count as fewer.
    alike = float(np.clip((rest[1:] @ rest[:-1]) / max(rest @ rest, 1e-300), 0.0, 0.9))
    freedom = max(len(values) * (1.0 - alike) / (1.0 + alike), 3.0) - 2.0
    error = np.sqrt(rest @ rest / (len(values) - 2) / (centred @ centred) * (1.0 + alike) / (1.0 - alike))
    scale = 100.0 * np.ptp(minutes) / values.mean()
    half = float(t.ppf(0.975, freedom) * error * scale)
    drift = float(slope * scale)
    return found | {
        "drift_percent": round(drift, 3),
        "drift_interval": [round(drift - half, 3), round(drift + half, 3)],
        "noise_percent": round(100.0 * float(rest.std()) / float(values.mean()), 3),
    }

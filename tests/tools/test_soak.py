"""``python -m tools.bench soak``: samples, and what is made of them."""

import json

import numpy as np
import pytest

from tools.bench.__main__ import main
from tools.bench.drift import judge


def table(speeds, memory, unstable=0):
    return [
        {"minute": float(i + 1), "env_steps": 1000 * (i + 1), "steps_per_s": 7.0, "steps_per_cpu_s": speed,
         "memory_mb": held, "unstable": unstable, "unstable_per_million": 1e3 * unstable / (i + 1)}
        for i, (speed, held) in enumerate(zip(speeds, memory, strict=True))
    ]  # fmt: skip


def noisy(count=60, drift=0.0, seed=0):
    generator = np.random.default_rng(seed)
    return 5000.0 * (1 + drift * np.linspace(-0.5, 0.5, count) + 0.01 * generator.standard_normal(count))


def test_a_short_soak_of_random_actions(capsys, tmp_path):
    out = tmp_path / "soak.json"
    words = ["--suite", "MT4", "--num-envs", "8", "--threads", "1", "--steps", "400", "--out", str(out), "--json"]
    main(["soak", *words])
    shown = capsys.readouterr()
    found = json.loads(shown.out)
    assert (found["env_steps"], found["num_envs"], found["what"]) == (400, 8, "random actions")
    rows = found["table"]
    assert 2 <= len(rows) <= 25 and [row["env_steps"] for row in rows] == sorted({row["env_steps"] for row in rows})
    assert all(row["steps_per_s"] > 1 and row["steps_per_cpu_s"] > 1 for row in rows)
    assert len(shown.err.strip().splitlines()) == len(rows) and "unstable" in shown.err
    assert found["verdict"].startswith("holds" if found["holds"] else "does not hold")
    assert json.loads(out.read_text()) == found


def test_growing_memory_and_falling_speed_do_not_hold():
    flat, growing = np.full(60, 500.0), np.linspace(500.0, 530.0, 60)
    steady = judge(table(noisy(), flat), "steps_per_cpu_s")
    assert steady["holds"] and steady["memory_growth_percent"] == 0.0 and steady["warm_up_minutes"] == 7.0
    low, high = steady["steps_per_cpu_s"]["drift_interval"]
    assert low < 0 < high and 0.8 < steady["steps_per_cpu_s"]["noise_percent"] < 1.2
    leak = judge(table(noisy(), growing), "steps_per_cpu_s")
    assert not leak["holds"] and leak["memory_growth_percent"] == pytest.approx(5.4, abs=0.2)
    slower = judge(table(noisy(drift=-0.05), flat), "steps_per_cpu_s")
    assert not slower["holds"] and slower["steps_per_cpu_s"]["drift_percent"] == pytest.approx(-4.5, abs=1.0)
    assert slower["verdict"].startswith("does not hold: memory +0.00 %")
    warm = judge(table(noisy(), np.where(np.arange(60) < 5, 300.0, 500.0)), "steps_per_cpu_s")
    assert warm["holds"]

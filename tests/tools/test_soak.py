"""``python -m tools.bench soak``: samples, and what is made of them."""

import json
import mmap
import subprocess
import sys

import numpy as np
import pytest
import torch

from tools.bench.__main__ import main
from tools.bench.drift import judge
from tools.bench.soak import resident, soak


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


def test_a_soak_of_a_learner_counts_its_worlds_steps_and_broken_rows(monkeypatch):
    from bidex_meta.world import World

    step = World.step

    def breaking(world, action):
        action = action.clone()
        action[0, 0] = torch.nan  # the row ends as unstable
        return step(world, action)

    monkeypatch.setattr(World, "step", breaking)
    found = soak("MT4", steps=512, num_envs=8, threads=1, algo="mtppo")
    assert found["what"] == "training" and found["env_steps"] >= 512
    last = found["table"][-1]
    assert last["unstable"] == last["env_steps"] // 8
    assert found["unstable_per_million"] == pytest.approx(1e6 / 8)


IMPORTED = """
import sys
from importlib import import_module

soak, loaded = import_module("tools.bench.soak"), []
take = soak._sample
soak._sample = lambda *given: (loaded.append(set(sys.modules)), take(*given))[1]
soak.soak("MT1", steps=400, num_envs=8, threads=1)
assert len(loaded) > 10, len(loaded)
print(*sorted(set(sys.modules) - loaded[0]))
"""


def test_a_soak_imports_nothing_after_its_first_sample():
    """What is imported then would pass for a leak: scipy alone is 59 MB."""
    done = subprocess.run([sys.executable, "-c", IMPORTED], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "\n"


def test_time_ends_a_soak():
    found = soak("MT1", minutes=0.02, num_envs=4, threads=1)
    assert 0.02 <= found["minutes"] < 0.2 and found["env_steps"] > 0


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


def test_the_drifts_interval_holds_zero_about_as_often_as_it_says():
    flat = np.full(40, 500.0)
    intervals = [judge(table(noisy(40, seed=i), flat), "steps_per_cpu_s")["steps_per_cpu_s"] for i in range(200)]
    hits = sum(each["drift_interval"][0] <= 0.0 <= each["drift_interval"][1] for each in intervals)
    assert 180 <= hits <= 199


def test_few_samples_and_no_memory_told():
    found = judge(table([5.0], [None]), "steps_per_cpu_s")
    assert found["holds"] and "memory is not told here" in found["verdict"] and "too few samples" in found["verdict"]


def test_resident_memory_grows_with_what_is_held():
    before = resident()
    if before is None:
        pytest.skip("the system does not tell")
    # A mapping of its own: an allocator may answer with pages that the process holds already.
    with mmap.mmap(-1, 40_000_000) as held:
        held.write(b"\1" * len(held))
        after = resident()
    assert after is not None and after - before > 30_000_000


@pytest.mark.parametrize(("words", "told"), [("--algo mtpo", "mtppo"), ("--suite MT5", "MT4")])
def test_a_misspelt_name_is_one_line(words, told):
    with pytest.raises(SystemExit, match=told):
        main(["soak", *words.split()])

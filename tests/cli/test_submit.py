"""The leaderboard: its statistics on known numbers, its files, and a submission that is played."""

import json
from pathlib import Path

import numpy as np
import pytest

from bidex_meta.cli import main
from bidex_meta.errors import BidexError
from bidex_meta.evaluation import leaderboard
from bidex_meta.evaluation.leaderboard import estimate, improvement, iqm, profile, read_entry
from tests.pages import ROOT
from tools.pages.leaderboard import leaderboard_table

SHIPPED = sorted((ROOT / "results" / "leaderboard").glob("*.json"))
SMALL = ["--suite", "MT4", "--num-envs", "6", "--threads", "1", "--device", "cpu", "--learner.hidden", "8"]


def classes(*rates: float, tasks: int = 10) -> list[np.ndarray]:
    """One seed that solves these shares of its tasks."""
    return [np.array([[1.0] * round(rate * tasks) + [0.0] * (tasks - round(rate * tasks))]) for rate in rates]


def test_measures_of_known_numbers() -> None:
    a, b = classes(0.0, 0.2, 0.6, 1.0), classes(0.1, 0.2, 0.5, 0.9)
    assert iqm(a) == pytest.approx(0.4)
    assert [profile(a, rate) for rate in (0.1, 0.6, 0.9)] == [0.75, 0.25, 0.25]
    assert improvement(a, b) == pytest.approx((0.0 + 0.5 + 1.0 + 1.0) / 4)
    assert improvement(a, b) + improvement(b, a) == pytest.approx(1.0)
    two = [np.concatenate(pair) for pair in zip(a, b, strict=True)]
    assert improvement(two, two) == pytest.approx(0.5)
    assert iqm(two) == pytest.approx((0.1 + 0.2 + 0.2 + 0.5 + 0.6 + 0.9 - 0.1 - 0.9) / 4)


def test_intervals_are_of_tasks_and_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leaderboard, "RESAMPLES", 400)
    found = estimate(lambda a: a[0].mean(), classes(0.5, tasks=100))
    assert found.interval is not None
    low, high = found.interval
    assert found.value == 0.5 and 0.15 < high - low < 0.24, "a share of 0.5 of 100: 1.96 * 2 * 0.05"
    apart = [np.array([[0.0] * 100, [1.0] * 100])]
    assert estimate(lambda a: a[0].mean(), apart).interval == (0.0, 1.0)
    assert estimate(iqm, classes(1.0, tasks=1)).interval is None


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_entries_fit(path: Path) -> None:
    entry = read_entry(path)
    for row in (*entry.own.values(), *entry.others.values()):
        assert row.success == pytest.approx(np.mean(row.tasks), abs=1e-3)
    assert path.name.startswith(f"{entry.suite}-")


def test_a_submission_is_played_and_ranked(toy_worlds, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(leaderboard, "RESAMPLES", 20)
    runs = [str(tmp_path / f"r{seed}") for seed in (0, 1)]
    for seed, run in enumerate(runs):
        assert main(["run", *SMALL, "--steps", "96", "--run-dir", run, "--seed", str(seed), "--no-evaluate"]) == 0
    out = tmp_path / "leaderboard"
    assert main(["submit", *runs, "--out", str(out), "--episodes", "2", "--device", "cpu"]) == 0
    entry = read_entry(out / "MT4-mtppo.json")
    assert (entry.suite, entry.version, entry.seeds, entry.steps) == ("MT4", 1, [0, 1], [96, 96])
    assert list(entry.own) == ["Near", "Far"] and entry.device == "cpu, 1 thread"
    lines = list(leaderboard_table("MT4", tmp_path / "data"))
    assert (
        len(lines) == 3 and lines[2].startswith("| 1 | mtppo | ") and not list(leaderboard_table("MT1", tmp_path / "x"))
    )
    capsys.readouterr()
    for words, said in (([*runs], "There is"), ([runs[0], runs[0], "--name", "x"], "Two of the runs have one seed")):
        assert main(["submit", *words, "--out", str(out)]) == 2
        assert said in capsys.readouterr().err
    broken = json.loads((out / "MT4-mtppo.json").read_text()) | {"seeds": [0]}
    (out / "broken.json").write_text(json.dumps(broken))
    with pytest.raises(BidexError, match="of 1 seeds"):
        read_entry(out / "broken.json")

"""Curves of several runs: grouping, interpolation, intervals."""

import json
from pathlib import Path

import numpy as np
import pytest

from bidex_meta.cli import main
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.comparison import over_runs, read_histories
from bidex_meta.evaluation.statistics import bootstrap_band, bootstrap_interval, mean
from bidex_meta.runs import RunFolder
from tests.test_comparison import run


def log(path: Path, *rows: dict) -> RunFolder:
    folder = RunFolder.open(path)
    folder.metrics_path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def test_a_band_is_the_interval_of_each_point():
    values = np.random.default_rng(3).normal(size=(8, 4))
    low, high = bootstrap_band(values)
    for point in range(4):
        ends = bootstrap_interval(mean, values[:, point])
        assert ends is not None
        width = ends[1] - ends[0]
        assert (low[point], high[point]) == pytest.approx(ends, abs=0.08 * width)


def test_curves_of_runs_meet_where_all_have_values():
    one = over_runs([(np.array([10.0, 20.0]), np.array([1.0, 2.0]))])
    assert one is not None and one.low is None and one.steps.tolist() == [10.0, 20.0]
    both = over_runs([(np.array([0.0, 100.0]), np.array([0.0, 100.0])), (np.array([50.0, 70.0]), np.array([1.0, 1.0]))])
    assert both is not None and both.low is not None and both.high is not None
    assert (both.steps[0], both.steps[-1], both.mean[0], both.mean[-1]) == (50.0, 70.0, 25.5, 35.5)
    assert (both.low[0], both.high[0]) == (1.0, 50.0)
    nothing = (np.array([]), np.array([]))
    assert over_runs([nothing]) is None
    left = over_runs([nothing, (np.array([1.0]), np.array([5.0]))])
    assert left is not None and left.low is None and left.mean.tolist() == [5.0]


def test_runs_are_grouped_whether_evaluated_or_not(tmp_path: Path):
    paths = [run(tmp_path, seed, {"A": 0.5}, gamma=0.9) for seed in (0, 1)]
    (paths[1] / "evaluation.json").unlink()
    other = run(tmp_path, 0, {"A": 0.5}, gamma=0.8)
    rows = [{"step": s, "time": 1.0, "Train/success/A": s / 100, "Loss/value": None} for s in (10, 20)]
    folders = [log(path, *rows) for path in (*paths, other)]
    first, second = read_histories(folders)
    assert (first.label, second.label) == ("mtppo, gamma 0.9", "mtppo, gamma 0.8")
    assert [len(each.runs) for each in (first, second)] == [2, 1]
    assert list(first.curves) == ["Train/success/A"]
    with pytest.raises(BidexError, match="holds nothing yet"):
        read_histories([log(paths[0])])


def test_plot_takes_several_runs_and_compare_draws(tmp_path: Path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rows = [{"step": s, "Train/success/A": s / 100, "Train/return/A": float(s)} for s in (10, 20)]
    paths = [run(tmp_path, seed, {"A": 0.5}) for seed in (0, 1)]
    for path in paths:
        log(path, *rows, {"step": 1000})
    names = list(map(str, paths))
    assert main(["plot", *names]) == 0
    assert capsys.readouterr().out == "curves.png\n"
    assert (tmp_path / "curves.png").read_bytes()[:4] == b"\x89PNG"
    assert main(["compare", *names, "--out", str(tmp_path / "c.svg")]) == 0
    assert "success, IQM" in (tmp_path / "c.svg").read_text()
    assert main(["plot", *names, "--adaptation"]) == 2
    assert "draws one run, got 2" in capsys.readouterr().err
    assert main(["plot"]) == 2

"""Transfer in numbers: areas, steps to a success that may never come, and what a start is worth above nothing."""

import json
from pathlib import Path

import numpy as np
import pytest

from bidex_meta.evaluation.transfer_measures import (
    add_over_nothing,
    area,
    by_reinforcement,
    median_steps,
    over_seeds,
    steps_to,
)
from bidex_meta.runs import RunFolder
from tests.fakes import log, run_config

STEPS = np.array([100.0, 200.0, 400.0])


def test_the_area_is_the_mean_success_over_all_steps():
    # 0 to 100 at 0.2, then 0.2 to 0.4, 0.4 to 1.0, and 400 to 500 at 1.0: 20 + 30 + 140 + 100 of 500.
    assert area(STEPS, np.array([0.2, 0.4, 1.0]), 500) == pytest.approx(290 / 500)
    # A last iteration goes beyond the end: at 300 it is 0.7, so that 20 + 30 + 55 of 300 count.
    assert area(STEPS, np.array([0.2, 0.4, 1.0]), 300) == pytest.approx(105 / 300)
    assert area(np.array([50.0]), np.array([0.25]), 1000) == pytest.approx(0.25)


def test_half_is_reached_by_two_evaluations_in_a_row():
    assert steps_to(STEPS, np.array([0.4, 0.5, 0.6])) == 200
    assert steps_to(STEPS, np.array([0.9, 0.1, 0.9])) is None, "one evaluation is chance"
    assert steps_to(STEPS[:1], np.array([1.0])) is None
    assert steps_to(STEPS, np.array([0.4, 0.5, 0.6]), level=0.4) == 100


def test_seeds_that_never_reach_it_count_as_later_than_all_others():
    assert median_steps([300, None, 200]) == 300
    assert median_steps([300, None, None]) is None
    assert median_steps([100, 200]) == 200 and median_steps([100, None]) is None
    assert median_steps([None, 7, 5, 6, None]) == 7


def runs(root: Path, *curves: list[float], end: float) -> list[RunFolder]:
    folders = []
    for seed, curve in enumerate(curves):
        folder = RunFolder.create(run_config(seed=seed), root / str(seed))
        rows = [{"step": int(step), "Eval/success_rate": value} for step, value in zip(STEPS, curve, strict=True)]
        log(folder.path, {"step": 50}, *rows)
        classes = {"Near": {"success": end, "return": 1.0, "score": None}}
        folder.evaluation_path.write_text(json.dumps({"steps": 500, "policy": {"classes": classes}}))
        folders.append(folder)
    return folders


def test_runs_become_measures_of_each_seed_and_of_all(tmp_path):
    found = by_reinforcement(runs(tmp_path, [0.2, 0.4, 1.0], [0.0, 0.0, 0.0], end=0.75), end=500)
    assert found["area"]["of_seeds"] == pytest.approx([0.58, 0.0]) and found["area"]["value"] == pytest.approx(0.29)
    assert found["area"]["interval"] == pytest.approx((0.0, 0.58))
    assert found["half"] == {"of_seeds": [None, None], "median": None}
    assert (found["success"]["value"], found["success"]["of_seeds"]) == (0.75, [0.75, 0.75])
    assert found["return"]["value"] == 1.0
    assert found["at"] == {} and found["curve"]["steps"][0] == 100 and found["curve"]["mean"][-1] == 0.5
    json.dumps(found)


def test_success_is_read_off_at_powers_of_ten_before_the_end(tmp_path):
    folders = runs(tmp_path, [0.2, 0.4, 1.0], end=0.0)
    log(folders[0].path, {"step": 5000, "Eval/success_rate": 0.0}, {"step": 15_000, "Eval/success_rate": 0.5})
    found = by_reinforcement(folders, end=200_000)["at"]
    assert {name: each["value"] for name, each in found.items()} == {"10000": 0.25, "100000": 0.5}
    assert found["10000"]["interval"] is None, "one seed says nothing of others"


def test_a_start_is_measured_against_nothing_of_the_same_class_and_demonstrations():
    def row(arm, count, *values, name="Near"):
        return {"class": name, "from": arm, "demonstrations": count, "success": over_seeds([*values])}

    rows = [row("run", 1, 0.5, 0.7), row("nothing", 1, 0.1, 0.3), row("run", 5, 0.5), row("run", 1, 0.9, name="Far")]
    add_over_nothing(rows, "success")
    assert rows[0]["over_nothing"]["value"] == pytest.approx(0.4)
    assert rows[0]["over_nothing"]["interval"] == pytest.approx((0.2, 0.6))
    assert [each["over_nothing"] for each in rows[1:]] == [None, None, None]

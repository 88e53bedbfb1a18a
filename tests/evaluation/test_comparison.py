import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bidex_meta.cli import main
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.comparison import over_runs, read_groups, read_histories, score_over, success_over
from bidex_meta.experiments.plotting import plot
from bidex_meta.runs import RunFolder
from tests.fakes import change, evaluated_run, log


def groups(*paths: Path):
    return read_groups([RunFolder.open(path) for path in paths])


def evaluated_at(path: Path, steps: int) -> Path:
    """The run, with steps in its evaluation."""
    found = json.loads((path / "evaluation.json").read_text())
    (path / "evaluation.json").write_text(json.dumps({**found, "steps": steps}))
    return path


def test_runs_that_differ_in_the_seed_alone_are_one_group(tmp_path: Path):
    paths = [evaluated_run(tmp_path, seed, {"A": 0.5, "B": seed / 10}, gamma=0.9) for seed in (2, 1)]
    other = evaluated_run(tmp_path, 1, {"A": 0.1, "B": 0.1}, gamma=0.8)
    first, second = groups(*paths, other)
    assert (first.label, first.seeds, second.label) == ("mtppo, gamma 0.9", [1, 2], "mtppo, gamma 0.8")
    assert np.array_equal(first.success, [[0.5, 0.1], [0.5, 0.2]]) and np.array_equal(first.returns, 10 * first.success)
    assert first.hours == 0.5 and first.steps == 1000


def test_runs_that_start_from_runs_of_their_own_seed_are_one_group(tmp_path: Path):
    paths = [evaluated_run(tmp_path, seed, {"A": 0.5}) for seed in (0, 1, 2)]
    for number, path in enumerate(paths[:2]):
        change(path, start_from=f"/runs/{number}")
    started, fresh = groups(*paths)
    assert (started.label, started.seeds) == ("mtppo, started from another run", [0, 1])
    assert (fresh.label, fresh.seeds) == ("mtppo, started afresh", [2])


@pytest.mark.parametrize(
    ("entry", "usual", "other", "label"),
    [
        ("dataset", [], ["HandOver/medium-v0"], "medium-v0"),
        ("dataset", ["HandOver/medium-v0"], ["HandOver/medium-v0", "/data/mine"], "medium-v0 + /data/mine"),
        ("demonstrations", [], ["HandOver/demonstrations-v0"], "demonstrations-v0"),
        ("points", 0, 256, "256"),
        ("object", None, "mug", "mug"),
        ("base", "own", "moving", "moving"),
    ],
)
def test_runs_of_other_data_or_worlds_are_other_groups(
    tmp_path: Path, entry: str, usual: object, other: object, label: str
):
    runs = [change(evaluated_run(tmp_path, s, {"A": 0.5}, "bc", task="HandOver"), **{entry: usual}) for s in (0, 1)]
    runs += [evaluated_run(tmp_path, 2, {"A": 0.5}, "bc", task="HandOver")] if not usual or usual == "own" else []
    (tmp_path / "x").mkdir()
    first, second = groups(
        *runs, change(evaluated_run(tmp_path / "x", 0, {"A": 0.5}, "bc", task="HandOver"), **{entry: other})
    )
    assert (len(first.seeds), second.seeds) == (len(runs), [0]), "configs that do not know the entry have the usual"
    assert second.label == f"bc, {entry} {label}"


def told(path: Path, **entries: Any) -> Path:
    """The run, with other entries in its evaluation."""
    found = json.loads((path / "evaluation.json").read_text())
    (path / "evaluation.json").write_text(json.dumps(found | entries))
    return path


def test_evaluations_by_another_protocol_are_other_groups(tmp_path: Path):
    runs = [evaluated_run(tmp_path, seed, {"A": 0.5}) for seed in (0, 1, 2)]
    told(runs[1], randomisation={"action_noise": 1.0})
    change(runs[2], processes=2)
    assert [group.seeds for group in groups(*runs)] == [[0], [1], [2]]
    shots = []
    for seed, count in enumerate((1, 2)):
        path = evaluated_run(tmp_path, seed, {"A": 0.5}, "rl2")
        row = {"classes": {"A": {"success": 0.5, "return": 1.0}}}
        part = {"shots": count, "rollouts": 2, "trials": 1, "before": row, "after": row, "by_shot": [row]}
        (path / "evaluation.json").write_text(json.dumps({"splits": {"test": part}}))
        shots.append(path)
    assert [group.label for group in groups(*shots)] == [f"rl2, shots on test {count} of 2" for count in (1, 2)]


def test_versions_of_the_rules_are_not_compared(tmp_path: Path):
    old, new = (evaluated_run(tmp_path, seed, {"A": 0.5}, gamma=seed / 10) for seed in (1, 2))
    classes = {"A": {"success": 0.5, "return": 5.0, "score": 50.0, "episode_steps": 100}}
    told(new, policy={"classes": classes})
    first, second = groups(old, new)
    assert success_over(second, first) is None and score_over(second, first) is None
    told(old, policy={"classes": classes})
    first, second = groups(old, new)
    assert success_over(second, first) is not None and score_over(second, first) is not None


def test_the_suite_names_the_version_of_an_evaluation_that_does_not(tmp_path: Path):
    """An evaluation of version 2 from before ``episode_steps``; no score of version 1 is computed for it."""
    old, new = (
        change(evaluated_run(tmp_path, seed, {"HandOver": 0.5}, gamma=seed / 10), base="moving") for seed in (1, 2)
    )
    change(new, suite="MT20-v2")
    told(new, policy={"classes": {"HandOver": {"success": 0.5, "return": 5.0}}})
    first, second = groups(old, new)
    assert (first.version, second.version, second.scores) == (1, 2, None)
    assert success_over(second, first) is None
    alone = evaluated_run(tmp_path, 3, {"HandOver": 0.5}, "ppo", task="HandOver-v2")
    assert groups(alone)[0].version == 2


def test_an_unusual_evaluation_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = told(evaluated_run(tmp_path, 0, {"A": 0.5}), split="test", randomisation={"action_noise": 1.0})
    usual = evaluated_run(tmp_path, 1, {"A": 0.5}, "mttrpo")
    assert main(["compare", str(path), str(usual)]) == 0
    assert "Evaluation of mtppo: split test, randomised." in capsys.readouterr().out
    assert main(["compare", str(path), str(usual), "--json"]) == 0
    assert [group["settings"] for group in json.loads(capsys.readouterr().out)] == [["split test", "randomised"], []]


def test_data_sets_called_as_their_class_leave_classes_one_group(tmp_path: Path):
    paths = [
        change(
            evaluated_run(tmp_path, 0, {c: 0.5}, "bc", task=c), dataset=[f"{c}/medium-v0"], demonstrations=[f"{c}/d"]
        )
        for c in ("A", "B")
    ]
    assert [(group.label, group.classes) for group in groups(*paths)] == [("bc", ["A", "B"])]


def test_runs_of_single_classes_make_one_seed_together(tmp_path: Path):
    paths = [evaluated_run(tmp_path, seed, {c: 0.5}, "ppo", task=c) for seed in (0, 1) for c in "AB"]
    [group] = groups(*paths)
    assert (group.label, group.classes, group.seeds, group.steps, group.hours) == ("ppo", ["A", "B"], [0, 1], 2000, 1.0)


def test_the_command_prints_tables_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    paths = [
        str(evaluated_run(tmp_path, s, {"A": 0.5, "B": 0.2 + s / 10}, algo))
        for algo in ("mtppo", "mttrpo")
        for s in (0, 1)
    ]
    assert main(["compare", *paths]) == 0
    out = capsys.readouterr().out
    assert "mttrpo" in out and "50.0 to 50.0" in out and "shows no difference" in out
    assert main(["compare", *paths, "--json"]) == 0
    first, second = json.loads(capsys.readouterr().out)
    assert first["success_over_first"] is None and second["success_over_first"]["value"] == 0.0
    assert second["classes"]["B"]["success"] == pytest.approx([0.2, 0.3]) and second["score_iqm"]["value"] > 0


def test_the_table_shows_each_class_under_its_own_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    first = evaluated_run(tmp_path, 0, {"B": 0.25, "A": 0.75})
    second, third = (
        evaluated_run(tmp_path, 0, {"A": 1.0, "B": 0.5}, "mttrpo"),
        evaluated_run(tmp_path, 0, {"C": 1.0}, "mtsac"),
    )
    assert main(["compare", str(first), str(second), str(third)]) == 0
    table = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("│")[1:4]] for line in table.splitlines() if "│" in line]
    of_class = [row for row in rows if row[0] in ("A", "B", "C")]
    groups = [row[0] for row in rows if row not in of_class]
    assert len(groups) == 3 and {row[1] for row in of_class} == {"mtppo", "mttrpo", "mtsac"}
    shares = [["B", "25.0"], ["B", "50.0"], ["A", "75.0"], ["A", "100.0"], ["C", "100.0"]]
    assert [[row[0], row[2]] for row in of_class] == shares


def test_an_evaluation_that_is_torn_or_of_fewer_steps_is_refused(tmp_path: Path):
    path = evaluated_at(evaluated_run(tmp_path, 0, {"A": 0.5}), 1016)
    assert groups(path)[0].steps == 1000
    with pytest.raises(BidexError, match="is of 500 steps, but the run continues to 1,000"):
        groups(evaluated_at(path, 500))
    (path / "evaluation.json").write_text("")
    with pytest.raises(BidexError, match="expected an evaluation in JSON"):
        groups(path)


def test_steps_are_the_mean_over_seeds_that_time_ended_with_their_range(tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")  # narrower tables leave columns out
    paths = [change(evaluated_run(tmp_path, seed, {"A": 0.5}), steps=10**9, minutes=4.0) for seed in range(3)]
    for path, steps in zip(paths, (1000, 1600, 4000), strict=True):
        log(evaluated_at(path, steps), {"step": steps})
    [group] = groups(*paths)
    assert (group.steps, group.steps_range) == (2200, (1000, 4000))
    assert main(["compare", *map(str, paths)]) == 0
    assert "2,200 (1,000 to 4,000)" in capsys.readouterr().out
    assert main(["compare", "--json", *map(str, paths)]) == 0
    [row] = json.loads(capsys.readouterr().out)
    assert (row["steps"], row["steps_range"]) == (2200, [1000, 4000])


@pytest.mark.parametrize(
    ("ends", "metrics", "over"),
    [
        ({"minutes": 4.0}, {}, True),
        ({"stop_at_return": 8.0}, {"Train/mean_return": 8.5}, True),
        ({"stop_at_return": 9.0}, {"Train/mean_return": 8.5}, False),
        ({"stop_at_return": 8.0, "evaluate_every": 10}, {"Train/mean_return": 8.5}, False),
        ({"stop_at_score": 33.0}, {"Eval/score": None}, False),
        ({"stop_at_score": 33.0}, {"Eval/score": 34.0}, True),
        ({"stop_at_success": 0.8}, {"Train/success_rate": 0.79}, False),
        ({"stop_at_success": 0.8}, {"Train/success_rate": 0.8}, True),
        ({"stop_at_success": 0.8}, {"Train/success_rate": 0.8, "Train/episodes": 99.0}, False),
        ({"stop_at_success": 0.8}, {"Train/success_rate": 0.8, "Train/episodes": 100.0}, True),
    ],
)
def test_a_run_that_time_or_a_mark_ended_is_of_the_steps_it_made(tmp_path: Path, ends, metrics, over):
    path = change(evaluated_at(evaluated_run(tmp_path, 0, {"A": 0.5}), 1000), steps=10**9, **ends)
    log(path, {"step": 500, "Train/mean_return": 2.0}, {"step": 1000, **metrics})
    if over:
        assert groups(path)[0].steps == 1000
    else:
        with pytest.raises(BidexError, match="is of 1,000 steps, but the run continues to 1,000,000,000"):
            groups(path)


def test_a_class_without_a_reference_leaves_the_group_without_a_score(tmp_path: Path):
    path = evaluated_run(tmp_path, 0, {"A": 0.5})
    (path / "evaluation.json").write_text(
        json.dumps({"policy": {"classes": {"A": {"success": 0.5, "return": 1.0, "score": None}}}})
    )
    assert groups(path)[0].scores is None


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    one = evaluated_run(tmp_path, 0, {"A": 0.5}, gamma=0.9)
    (tmp_path / "again").mkdir()
    with pytest.raises(BidexError, match="second run of mtppo with seed 0"):
        groups(one, evaluated_run(tmp_path / "again", 0, {"A": 0.5}, gamma=0.9))
    with pytest.raises(BidexError, match="same classes"):
        groups(one, evaluated_run(tmp_path / "again", 1, {"B": 0.5}, gamma=0.9))
    (one / "evaluation.json").unlink()
    for words, told in (
        ([], "Name the run"),
        ([str(one)], "no evaluation.json"),
        ([str(tmp_path)], "not a run folder"),
    ):
        assert main(["compare", *words]) == 2
        assert told in capsys.readouterr().err


# Curves over training.


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
    paths = [evaluated_run(tmp_path, seed, {"A": 0.5}, gamma=0.9) for seed in (0, 1)]
    (paths[1] / "evaluation.json").unlink()
    other = evaluated_run(tmp_path, 0, {"A": 0.5}, gamma=0.8)
    rows = [{"step": s, "time": 1.0, "Train/success/A": s / 100, "Loss/value": None} for s in (10, 20)]
    folders = [log(path, *rows) for path in (*paths, other)]
    first, second = read_histories(folders)
    assert (first.label, second.label) == ("mtppo, gamma 0.9", "mtppo, gamma 0.8")
    assert [len(each.runs) for each in (first, second)] == [2, 1]
    assert list(first.curves) == ["Train/success/A"]
    with pytest.raises(BidexError, match="has no metrics to draw yet"):
        read_histories([log(paths[0])])


def test_a_run_is_not_counted_twice(tmp_path: Path):
    paths = [evaluated_run(tmp_path / name, seed, {"A": 0.5}) for name, seed in (("a", 0), ("b", 1), ("c", 1))]
    rows = [{"step": step, "time": step / 7, "Train/success/A": 0.1} for step in range(1, 9)]
    whole, snapshot = log(paths[0], *rows), log(paths[1], *rows[:4])
    for runs in ([whole, snapshot], [snapshot, whole]):
        with pytest.raises(BidexError, match="counts as one seed"):
            read_histories(runs)
    log(paths[1], {"step": 1, "time": 3.0, "Train/success/A": 0.1})
    other = log(paths[2], {"step": 1, "time": 4.0, "Train/success/A": 0.1})
    with pytest.raises(BidexError, match="second run of mtppo with seed 1 on MT4"):
        read_histories([whole, snapshot, other])


@pytest.mark.parametrize(
    ("algos", "told"),
    [(["bc", "iql"], "gradient updates"), (["mtppo"], "environment steps"), (["bc", "mtppo"], "environment steps, or")],
)
def test_steps_of_learners_on_data_are_updates(tmp_path: Path, algos: list[str], told: str):
    runs = [RunFolder.open(evaluated_run(tmp_path, 0, {"A": 0.5}, algo)) for algo in algos]
    for run in runs:
        log(run.path, {"step": 5, "Train/success/A": 0.1, "Train/return/A": 1.0})
    plot(runs, tmp_path / "a.svg")
    assert f"<!-- {told}" in (tmp_path / "a.svg").read_text()


def test_plot_takes_several_runs_and_compare_draws(tmp_path: Path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rows = [{"step": s, "Train/success/A": s / 100, "Train/return/A": float(s)} for s in (10, 20)]
    paths = [evaluated_run(tmp_path, seed, {"A": 0.5}) for seed in (0, 1)]
    for path in paths:
        log(path, *rows, {"step": 1000})
    names = list(map(str, paths))
    assert main(["plot", *names]) == 0
    assert capsys.readouterr().out == "curves.png\n"
    assert (tmp_path / "curves.png").read_bytes()[:4] == b"\x89PNG"
    assert main(["compare", *names, "--out", str(tmp_path / "c.svg")]) == 0
    assert "success, IQM" in (tmp_path / "c.svg").read_text()
    assert main(["plot", *names, "--adaptation"]) == 2
    assert "draws a single run, got 2" in capsys.readouterr().err
    assert main(["plot"]) == 2

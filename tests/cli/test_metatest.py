"""``run``, ``evaluate``, ``plot`` and ``compare`` of a learner that adapts, on points in the plane."""

import json
from pathlib import Path

import pytest
import torch

from bidex_meta.cli import learners, main
from bidex_meta.cli.metatest import environments_for, rollouts_of
from bidex_meta.evaluation.comparison import read_groups
from bidex_meta.runs import RunFolder
from bidex_meta.worlds import Worlds
from bidex_meta.worlds.own import OwnSuite
from tests.adapting_learner import Learner
from tests.fakes import change, run_config
from tests.points import PointWorld, ring

COUNTS = {"train": {"Near": 6, "Far": 6}, "test": {"Near": 2}}


def points(source, split="train", rows=None, mode="DISABLED"):
    pools = {name: ring(count, split == "test") for name, count in COUNTS[split].items()}
    place = PointWorld(rows or 12, pools, mode=mode)
    place.state_dict = dict  # type: ignore[attr-defined]
    place.load_state_dict = lambda state: None  # type: ignore[attr-defined]
    return place


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(OwnSuite, "world", points)
    pools = {split: {name: [""] * count for name, count in counts.items()} for split, counts in COUNTS.items()}
    monkeypatch.setattr(OwnSuite, "tasks", lambda source, split: pools[split])
    monkeypatch.setitem(learners.ALGOS, "finder", "tests.adapting_learner:Learner")
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def run(tmp_path) -> Path:
    path = tmp_path / "r"
    flags = ["--suite", "ML4", "--algo", "finder", "--num-envs", "24", "--steps", "24", "--threads", "1"]
    assert main(["run", *flags, "--device", "cpu", "--run-dir", str(path)]) == 0
    return path


def evaluate(capsys, *arguments):
    capsys.readouterr()
    assert main(["evaluate", *map(str, arguments)]) == 0
    return capsys.readouterr()


def test_a_run_ends_with_both_tables_of_both_splits_and_trains_on_the_learners_kind_of_world(capsys, request):
    run = request.getfixturevalue("run")  # after capsys, so that what it prints is caught
    shown = capsys.readouterr()
    for split, classes in COUNTS.items():
        assert f"{split} tasks, before adaptation" in shown.out
        assert f"{split} tasks, after 1 shot of 4 episodes" in shown.out
        assert all(name in shown.out for name in classes)
    assert "return gained [95 %]" in shown.out
    assert "5 of 6 tasks of each, 1 shot of 4 episodes, 4 evaluation episodes, 40 environments." in shown.err
    loaded = RunFolder.open(run).checkpoints.load()
    assert loaded is not None and loaded[0]["learner"]["mode"] == "DISABLED"
    stored = json.loads((run / "evaluation.json").read_text())
    assert list(stored["splits"]) == ["train", "test"] and stored["steps"] == 24


def test_a_run_is_told_what_its_meta_test_plays(tmp_path, capsys):
    path = tmp_path / "r"
    flags = ["run", "--suite", "ML4", "--algo", "finder", "--num-envs", "24", "--steps", "24", "--device", "cpu"]
    flags += ["--threads", "1", "--run-dir", str(path)]
    assert main([*flags, "--split", "test", "--shots", "2", "--rollouts", "7", "--tasks", "1"]) == 0
    splits = json.loads((path / "evaluation.json").read_text())["splits"]
    assert list(splits) == ["test"] and [splits["test"][name] for name in ("shots", "rollouts", "trials")] == [2, 7, 5]
    assert (
        not {"split", "shots", "rollouts", "tasks"} & RunFolder.open(path).config().to_json().keys()
    )  # a resumed run may differ
    capsys.readouterr()
    assert main([*flags[:-1], str(tmp_path / "other"), "--rollouts", "0"]) == 2
    assert "--rollouts" in capsys.readouterr().err
    flags[flags.index("finder")] = "mtppo"
    assert main([*flags[:-1], str(tmp_path / "other"), "--shots", "2"]) == 2
    assert "--shots is for learners that adapt" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


def test_evaluate_agrees_with_the_run_and_takes_shots_rollouts_tasks_and_trials(run, capsys):
    again = json.loads(evaluate(capsys, run, "--json").out)
    assert again["splits"] == json.loads((run / "evaluation.json").read_text())["splits"]
    flags = ["--shots", 2, "--rollouts", 3, "--tasks", 2, "--trials", 2, "--episodes", 5, "--split", "test"]
    found = json.loads(evaluate(capsys, run, "--json", *flags).out)["splits"]
    assert list(found) == ["test"]
    part = found["test"]
    assert (part["shots"], part["rollouts"], part["trials"], part["max_adapt_steps"]) == (2, 3, 2, 6)
    near = part["by_shot"][2]["classes"]["Near"]
    assert (near["episodes"], near["tasks"]) == (2 * 2 * 5, 2)
    assert part["adapt_steps"] == [2 * 2 * 3 * 6] * 2


def test_fewer_rows_are_only_slower(run, capsys):
    many, few = (
        json.loads(evaluate(capsys, run, "--json", "--num-envs", rows).out)["splits"]["train"] for rows in (1024, 8)
    )
    for found in (many, few):
        assert found["before"]["classes"]["Near"]["episodes"] == 20
        assert found["gain"]["classes"]["Near"]["return"]["interval"][0] > 0


def test_no_shots_show_one_table_a_split(run, capsys):
    shown = evaluate(capsys, run, "--shots", 0).out
    assert shown.count("before adaptation") == 2 and "after" not in shown


def test_the_curve_of_adaptation(run, capsys, tmp_path):
    assert main(["plot", str(run), "--adaptation"]) == 0
    assert (run / "adaptation.png").stat().st_size > 0
    other = tmp_path / "three.json"
    other.write_text(evaluate(capsys, run, "--json", "--shots", 3).out)
    assert main(["plot", str(run), "--evaluation", str(other), "--out", str(tmp_path / "a.png")]) == 0
    assert (tmp_path / "a.png").stat().st_size > 0
    other.write_text('{"policy": {}}')
    capsys.readouterr()
    assert main(["plot", str(run), "--evaluation", str(other)]) == 2
    assert "holds no meta-test" in capsys.readouterr().err


def test_compare_takes_what_is_reached_after_adaptation(run):
    [group] = read_groups([RunFolder.open(run)])
    assert group.classes == ["Near (train)", "Far (train)", "Near (test)"]


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (["--shots", "-1"], "--shots"),
        (["--rollouts", "0"], "--rollouts"),
        (["--random"], "Leave --random out"),
        (["--split", "tets"], "both"),
    ],
)
def test_bad_flags_are_one_line(run, capsys, flags, expected):
    capsys.readouterr()
    assert main(["evaluate", str(run), *flags]) == 2
    error = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("Meta-test on")]
    assert len(error) == 1 and expected in error[0]


def test_what_does_not_adapt_takes_no_shots(run, capsys):
    change(run, algo="mtppo")
    for flag in ("--shots", "--trials"):
        capsys.readouterr()
        assert main(["evaluate", str(run), flag, "3"]) == 2
        expected = f"bidex-meta: mtppo does not adapt to tasks, got {flag} 3. Leave it out.\n"
        assert capsys.readouterr().err == expected


@pytest.mark.parametrize("shown", [("--suite", "metaworld/MT3"), ("--suite", "MT4"), ("--task", "Switch")])
def test_no_adaptation_where_tasks_are_shown(capsys, tmp_path, monkeypatch, shown):
    monkeypatch.chdir(tmp_path)
    assert main(["run", *shown, "--algo", "finder", "--device", "cpu"]) == 2
    assert f"finder adapts to hidden goals, but {shown[1]} shows them. Name an ML suite" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_where_rows_share_nothing_each_plays_one_episode_a_shot(monkeypatch):
    config = run_config(suite="ML4", algo="finder", num_envs=1024)
    source = Worlds.open(config.to_json())
    assert [rollouts_of(source, config, asked, 6) for asked in (20, None)] == [20, 10]
    monkeypatch.setattr(Learner, "independent_adaptation", True, raising=False)
    assert [rollouts_of(source, config, asked, 6) for asked in (20, None, 4)] == [6, 6, 4]


@pytest.mark.parametrize(
    ("classes", "adaptations", "rollouts", "limit", "rows"),
    [
        (1, 3, 10, 1024, 30),  # ML1: all at once
        (15, 50, 10, 1024, 15 * 6 * 10),  # ML20: nine portions of six, rather than eight of six and one of two
        (15, 4, 10, 1024, 15 * 4 * 10),
        (15, 5, 20, 1024, 15 * 3 * 20),  # two portions of three
        (15, 5, 20, 200, 15 * 10),  # ten rows a class, two rounds
        (15, 5, 20, 140, 15 * 5),  # nine would not divide twenty
        (15, 5, 20, 3, 15),
    ],
)
def test_rows_fit_the_limit_and_the_rollouts(classes, adaptations, rollouts, limit, rows):
    assert environments_for(classes, adaptations, rollouts, limit) == rows


def test_while_training_an_adapting_learner_is_judged_after_a_shot_on_train_tasks(tmp_path):
    flags = ["--suite", "ML4", "--algo", "finder", "--num-envs", "24", "--steps", "72", "--threads", "1"]
    flags += ["--device", "cpu", "--run-dir", str(tmp_path / "r"), "--no-evaluate", "--evaluate-every", "2"]
    assert main(["run", *flags]) == 0
    rows = [json.loads(line) for line in (tmp_path / "r" / "metrics.jsonl").read_text().splitlines()]
    assert ["Eval/success_rate" in row for row in rows] == [False, True, False]
    assert rows[1]["Eval/success_rate"] > rows[1]["Eval/success_before_adapt"]
    assert (tmp_path / "r" / "checkpoints" / "best.pt").is_file()

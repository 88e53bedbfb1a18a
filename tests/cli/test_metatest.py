"""``run``, ``evaluate``, ``plot`` and ``compare`` of a learner that adapts, on points in the plane."""

import json

import pytest

from bidex_meta.cli import main
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.comparison import read_groups
from bidex_meta.experiments.evaluating import meta_test
from bidex_meta.experiments.metatest import Adaptation, rollouts_of
from bidex_meta.runs import RunFolder
from bidex_meta.training.learner import Capability
from bidex_meta.worlds import open_worlds
from bidex_meta.worlds.own import OwnSuite
from tests.adapting_learner import Learner
from tests.cli.conftest import COUNTS, FINDER, points
from tests.fakes import change, run_config

pytestmark = pytest.mark.usefixtures("finder")


def test_a_run_ends_with_the_table_of_each_split_and_trains_on_the_learners_kind_of_world(capsys, tmp_path):
    run = tmp_path / "r"
    assert main(["run", *FINDER, "--run-dir", str(run)]) == 0
    shown = capsys.readouterr()
    for split, classes in COUNTS.items():
        assert f"24 steps, {split} tasks" in shown.out
        assert all(name in shown.out for name in classes)
    assert all(f"after {shot}" in shown.out for shot in range(3))
    assert shown.out.count("gained") == 2 * (1 + 1), "a column and its caption, of each split"
    assert "5 of 6 tasks of each, 2 shots of 4 episodes, 4 evaluation episodes, 40 environments." in shown.err
    loaded = RunFolder.open(run).checkpoints.load()
    assert loaded is not None and loaded[0]["learner"]["mode"] == "DISABLED"
    stored = json.loads((run / "evaluation.json").read_text())
    assert list(stored["splits"]) == ["train", "test"] and stored["steps"] == 24


def test_flags_say_what_the_meta_test_of_a_run_plays(tmp_path, refused):
    path, flags = tmp_path / "r", ["run", *FINDER, "--run-dir"]
    asked = ["--split", "test", "--shots", "2", "--rollouts", "7", "--tasks", "1", "--hidden-rewards"]
    assert main([*flags, str(path), *asked]) == 0
    splits = json.loads((path / "evaluation.json").read_text())["splits"]
    assert list(splits) == ["test"] and [splits["test"][name] for name in ("shots", "rollouts", "trials")] == [2, 7, 5]
    assert len(splits["test"]["hidden_by_shot"]) == 3
    # A resumed run may have another value.
    assert (
        not {"split", "shots", "rollouts", "tasks", "hidden_rewards"} & RunFolder.open(path).config().to_json().keys()
    )
    assert "--rollouts" in refused(*flags, tmp_path / "other", "--rollouts", "0")
    assert "--hidden-rewards" in refused(*flags, tmp_path / "other", "--hidden-rewards", "--algo", "mtppo")
    other = refused(*flags, tmp_path / "other", "--shots", "2", "--algo", "mtppo")
    assert "mtppo does not adapt to tasks, got --shots 2" in other and not (tmp_path / "other").exists()


def test_evaluate_agrees_with_the_run_and_takes_shots_rollouts_tasks_and_trials(adapted, shown):
    again = json.loads(shown("evaluate", adapted, "--json"))
    assert again["splits"] == json.loads((adapted / "evaluation.json").read_text())["splits"]
    flags = ["--shots", 2, "--rollouts", 3, "--tasks", 2, "--trials", 2, "--episodes", 5, "--split", "test"]
    found = json.loads(shown("evaluate", adapted, "--json", *flags))["splits"]
    assert list(found) == ["test"]
    part = found["test"]
    assert (part["shots"], part["rollouts"], part["trials"], part["max_adapt_steps"]) == (2, 3, 2, 6)
    near = part["by_shot"][2]["classes"]["Near"]
    assert (near["episodes"], near["tasks"]) == (2 * 2 * 5, 2)
    assert part["adapt_steps"] == [2 * 2 * 3 * 6] * 2
    text = shown("evaluate", adapted, "--json", "--split", "unseen")
    others, test = json.loads(text)["splits"].values()
    assert test["split"] == "test" and test["before"]["classes"].keys() == COUNTS["test"].keys()
    assert others["split"] == "others" and others["before"]["classes"].keys() == COUNTS["train"].keys()
    (adapted.parent / "others.json").write_text(text)
    shown("verify", adapted, "--evaluation", adapted.parent / "others.json")
    few = json.loads(shown("evaluate", adapted, "--json", "--num-envs", 8))["splits"]["train"]  # only slower
    assert few["before"]["classes"]["Near"]["episodes"] == 20
    assert few["gain"]["classes"]["Near"]["return"]["interval"][0] > 0
    none = shown("evaluate", adapted, "--shots", 0)
    assert "after 0" in none and "after 1" not in none and "gained" not in none


def test_hidden_rewards_are_a_second_row_and_are_verified(adapted, shown, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")  # narrower tables break names
    flags = ["evaluate", adapted, "--split", "test", "--hidden-rewards"]
    table = shown(*flags)
    assert [word in table for word in ("shown", "hidden", "after 2")] == [True] * 3
    (tmp_path / "hidden.json").write_text(shown(*flags, "--json"))
    part = json.loads((tmp_path / "hidden.json").read_text())["splits"]["test"]
    assert len(part["hidden_by_shot"]) == len(part["by_shot"]) == 3
    again = shown("verify", adapted, "--evaluation", tmp_path / "hidden.json")
    assert "6 classes: 6 equal" in again and "Near (test, shot 2, rewards hidden)" in again


def test_the_curve_of_adaptation(adapted, shown, refused, tmp_path):
    shown("plot", adapted, "--adaptation")
    assert (adapted / "adaptation.png").stat().st_size > 0
    other, picture = tmp_path / "three.json", tmp_path / "a.png"
    other.write_text(shown("evaluate", adapted, "--json", "--shots", 3))
    shown("plot", adapted, "--evaluation", other, "--out", picture)
    assert picture.stat().st_size > 0
    other.write_text('{"policy": {"classes": {"A": {"success": 0.5, "return": 1.0}}}}')
    assert "holds no meta-test" in refused("plot", adapted, "--evaluation", other)


def test_compare_takes_what_is_reached_after_adaptation(adapted):
    [group] = read_groups([RunFolder.open(adapted)])
    assert group.classes == ["Near (train)", "Far (train)", "Near (test)"]


@pytest.mark.parametrize(
    "flags, expected",
    [
        ("--shots -1", "--shots"),
        ("--rollouts 0", "--rollouts"),
        ("--random", "Leave --random"),
        ("--split x", "unseen"),
    ],
)
def test_bad_flags_are_one_line(adapted, refused, flags, expected):
    error = [line for line in refused("evaluate", adapted, *flags.split()).splitlines() if "Meta-test on" not in line]
    assert len(error) == 1 and expected in error[0]


def test_an_unknown_split_is_refused_in_python(adapted):
    with pytest.raises(BidexError, match="split: expected one of auto, train, test, others, unseen, got 'both'"):
        meta_test(adapted, split="both")


def test_what_does_not_adapt_takes_no_shots(adapted, refused):
    change(adapted, algo="mtppo")
    for words in ("--shots 3", "--trials 3", "--hidden-rewards"):
        expected = f"bidex-meta: mtppo does not adapt to tasks, got {words}. Leave it out.\n"
        assert refused("evaluate", adapted, *words.split()) == expected


@pytest.mark.parametrize("on", [("--suite", "metaworld/MT3"), ("--suite", "MT4"), ("--task", "Switch")])
def test_no_adaptation_where_tasks_are_shown(refused, tmp_path, monkeypatch, on):
    monkeypatch.chdir(tmp_path)
    error = refused("run", *on, "--algo", "finder", "--device", "cpu")
    assert f"finder adapts to hidden goals, but {on[1]} shows them. Name an ML suite" in error
    assert list(tmp_path.iterdir()) == []


def test_where_rows_share_nothing_each_plays_one_episode_a_shot(monkeypatch):
    config = run_config(suite="ML4", algo="finder", num_envs=1024)
    source = open_worlds(config.to_json())
    shared = Adaptation.of(source, config)
    assert [rollouts_of(shared, asked, 6) for asked in (20, None)] == [20, 10]
    monkeypatch.setattr(Learner, "capabilities", frozenset(Capability))
    alone = Adaptation.of(source, config)
    assert [rollouts_of(alone, asked, 6) for asked in (20, None, 4)] == [6, 6, 4]


def test_unseen_tasks_are_those_of_another_seed_and_of_the_test_split(adapted, shown, monkeypatch):
    played = set()

    def recorded(source, split="train", rows=None, mode="DISABLED"):
        played.add((split, source.seed))
        return points(source, split, rows, mode)

    monkeypatch.setattr(OwnSuite, "world", recorded)
    shown("evaluate", adapted, "--json", "--split", "unseen")
    assert played == {("train", 500_000), ("test", 0)}


def test_while_training_an_adapting_learner_is_judged_after_a_shot_on_train_tasks(tmp_path):
    flags = ["--steps", "72", "--run-dir", str(tmp_path / "r"), "--no-evaluate", "--evaluate-every", "2"]
    assert main(["run", *FINDER, *flags]) == 0
    rows = RunFolder.open(tmp_path / "r").metrics()
    assert ["Eval/success_rate" in row for row in rows] == [False, True, False]
    assert rows[1]["Eval/success_rate"] > rows[1]["Eval/success_before_adapt"]
    assert "Eval/success/Far" in rows[1], "no test task is of this class"
    assert (tmp_path / "r" / "checkpoints" / "best.pt").is_file()


def test_a_meta_test_notes_what_it_is_at(adapted, noted) -> None:
    assert main(["evaluate", str(adapted), "--split", "test"]) == 0
    parts = {"Building the world of ML4", "Playing episodes to adapt to", "Adapting", "Playing episodes to evaluate"}
    assert parts <= {*noted}

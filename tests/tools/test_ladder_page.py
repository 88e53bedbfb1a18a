"""The table of the ladder: lines, the gap that is closed, pairs, and the rule that a suite keeps or not."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from bidex_meta.errors import BidexError
from bidex_meta.runs.evaluations import (
    ClassSummary,
    Estimate,
    Gains,
    MetaTestEvaluation,
    OtherTasks,
    PolicyEvaluation,
    SplitSummary,
    Summary,
)
from tools.pages.gained import adaptation_table, gains_table
from tools.pages.ladder import BLIND, SHOWN, ladder_figure, ladder_table, suites_table

SUITE = "ML1-DoorOpenOutward-choice4"
OTHER_TEST_TASKS = "ML1-DoorOpenOutward-shared"


def summary(success: float) -> Summary:
    return Summary(classes={"Door": ClassSummary(success=success, mean_return=1.0)})


def run(
    arm: str, seed: int, *success: float, suite: str = SUITE, hidden: float | None = None, unseen: float | None = None,
    rollouts: int = 1, start_from: str | None = None
) -> Any:  # fmt: skip
    """A stored run: of a learner that adapts if there is success after several numbers of episodes."""
    if len(success) == 1:
        other_tasks = None if unseen is None else OtherTasks(policy=summary(unseen))
        found: Any = PolicyEvaluation(policy=summary(success[0]), other_tasks=other_tasks)
        algo = "mtppo"
    else:
        shots = [summary(share) for share in success]
        split = SplitSummary(
            split="test", shots=2, rollouts=rollouts, trials=1, before=shots[0], after=shots[-1], by_shot=shots,
            rewards_shown=True, hidden_by_shot=None if hidden is None else [summary(hidden)] * 3,
        )  # fmt: skip
        found = MetaTestEvaluation(splits={"test": split})
        algo = arm if arm in ("icl", "maml") else "rl2"
    settings = {"algo": algo, "suite": suite, "seed": seed}
    content = {
        "name": f"{arm}-{seed}", "steps": 1000, "seconds": 120.0, "suite": {"name": suite}, "config": settings
    }  # fmt: skip
    config = SimpleNamespace(algo=algo, seed=seed, task=None, start_from=start_from)
    path = Path("results/data/ladder.json")
    return SimpleNamespace(arm=arm, path=path, content=content, evaluation=lambda: found, config=lambda: config)


def table(*runs: Any) -> list[str]:
    study: Any = SimpleNamespace(split=None, runs=runs)
    return list(ladder_table(study))


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def learners(shown: float = 0.9, blind: float = 0.1) -> list[Any]:
    runs = []
    for seed in (0, 1, 2):
        runs.append(run("ppo", seed, shown + 0.01 * seed, suite=SUITE.replace("ML", "MT")))
        runs.append(run("ppo", seed, blind))
        runs.append(run("icl", seed, 0.1, 0.8, 0.9))
        runs += [
            run(name, seed, 0.1, level, level + 0.005 * seed) for name, level in (("a", 0.7), ("b", 0.4), ("c", 0.2))
        ]
    return runs


def test_lines_stand_between_goal_shown_and_blind() -> None:
    lines = table(*learners())
    assert lines[0] == f"**{SUITE}**"
    rows = [cells(line) for line in lines[4:10]]
    assert [row[0] for row in rows] == [SHOWN, "icl", "a", "b", "c", BLIND]
    assert rows[1][1] == "teachers, rewards of other goals" and rows[2][1] == "own rewards"
    assert rows[2][2:6] == ["3", "1,000", "2", "1"] and rows[0][5] == ""
    assert rows[2][6:10] == ["10 % (10 to 10)", "70 % (70 to 70)", "70.5 % (70 to 71)", ""]
    assert rows[2][-1].startswith(f"{100 * (0.705 - 0.1) / (0.91 - 0.1):.0f} %")
    assert rows[0][-1] == rows[-1][-1] == ""


def test_a_shot_has_the_episodes_that_environments_of_a_task_share() -> None:
    alone = run("a", 0, 0.1, 0.2, 0.3, rollouts=25)
    shared = run("maml", 0, 0.1, 0.2, 0.3, rollouts=25)
    rows = [cells(line) for line in table(alone, shared)[4:6]]
    assert [row[5] for row in rows] == ["1", "25"]


def test_steps_and_minutes_include_the_runs_that_a_learner_starts_from() -> None:
    blind = run("ppo", 0, 0.1)
    adapts = run("maml", 0, 0.1, 0.2, 0.3, start_from="ppo-0")
    assert [cells(line)[3:5] for line in table(adapts, blind)[4:6]] == [["1,000 + 1,000", "2 + 2"], ["1,000", "2"]]
    with pytest.raises(BidexError, match=r"maml-0 started from the policy of ppo-0\. Collect that run too"):
        table(adapts)


def test_the_figure_says_how_many_episodes_a_shot_has() -> None:
    runs = [run("maml", 0, 0.1, 0.2, 0.3, suite=SUITE, rollouts=25), run("a", 0, 0.1, 0.2, 0.3, rollouts=25)]
    runs.append(run("maml", 0, 0.1, 0.2, 0.3, suite=OTHER_TEST_TASKS, rollouts=10))
    study: Any = SimpleNamespace(split=None, runs=runs)
    legend = ladder_figure(study).legends[0]
    assert {text.get_text() for text in legend.get_texts()} == {"a", "maml, 10 to 25 episodes per shot"}


def test_pairs_are_of_learners_that_see_their_own_rewards() -> None:
    lines = table(*learners())
    assert any(line.startswith("This suite meets the criteria below. In 3 pairs of learners") for line in lines)
    pairs = [cells(line) for line in lines[-3:]]
    assert [(first, second, apart) for first, second, *_, apart in pairs] == [
        ("a", "b", "yes"), ("a", "c", "yes"), ("b", "c", "yes")
    ]  # fmt: skip
    assert pairs[0][2:4] == ["1.00", "0.10"]  # two of the twenty divisions of six runs are as clear


def test_suites_stand_with_their_validity_and_both_lines(tmp_path: Path) -> None:
    rows = {"Door": {"hidden": ["left_angle"], "blind": 0.25, "named": 0.264, "chance": 0.25, "identified": 1.0}}
    rows["Door"]["explained"] = -0.04
    (tmp_path / "validity").mkdir()
    (tmp_path / "validity" / f"{SUITE}.json").write_text(json.dumps({"classes": rows}))
    runs = learners()
    runs[0].path = tmp_path / "data" / "ladder.json"
    study: Any = SimpleNamespace(split=None, runs=runs)
    row = cells(list(suites_table(study))[2])
    assert row == [
        SUITE,
        "left_angle",
        "25.0 %",
        "26.4 % (25 %), R² -0.04",
        "100.0 %",
        "10 % (10 to 10)",
        "91 % (90 to 92)",
    ]
    runs[0].path = tmp_path / "elsewhere" / "data" / "ladder.json"
    assert cells(list(suites_table(study))[2])[:5] == [SUITE, "", "", "", ""]


def test_success_on_train_tasks_is_marked_unless_they_are_the_test_tasks() -> None:
    seen = [run("ppo", seed, 0.1, suite=OTHER_TEST_TASKS) for seed in (0, 1)]
    unseen = [run("ppo", seed, 0.1, suite=OTHER_TEST_TASKS, unseen=0.3) for seed in (0, 1)]
    for rows in (table(*seen), list(suites_table(SimpleNamespace(split=None, runs=seen)))):  # pyright: ignore
        assert any("| 10 % (10 to 10) on train tasks |" in line for line in rows)
    assert any("| 30 % (30 to 30) |" in line for line in table(*unseen))
    assert not any("on train tasks" in line for line in table(*learners())), "a choice suite tests its train tasks"
    with pytest.raises(BidexError, match=f"blind PPO on {OTHER_TEST_TASKS}, but some are only on train tasks"):
        table(seen[0], unseen[1])


def test_gains_are_compared_with_a_control_of_the_same_budget() -> None:
    runs = []
    for arm, value, most in (("control", 1.0, 150), ("ProMP", 3.0, 150), ("ProMP whole episodes", 4.0, 500)):
        gains = Gains({"Door": {"return": Estimate(value, None)}}, {})
        part = SplitSummary(
            shots=2, rollouts=4, trials=1, max_adapt_steps=most, before=summary(0.1), after=summary(0.2), gain=gains,
            by_shot=[summary(0.1)],
        )  # fmt: skip
        runs.append(run(arm, 0, 0.1, 0.2))
        runs[-1].evaluation = lambda part=part: MetaTestEvaluation(splits={"test": part})
    study: Any = SimpleNamespace(name="s", split=None, runs=runs)
    over = {cells(line)[1]: cells(line)[-1] for line in list(gains_table(study))[2:]}
    assert over == {"ProMP": "+2", "ProMP whole episodes": "", "control": ""}


def test_classes_have_success_by_shot_above_what_is_possible_without_the_goal(tmp_path: Path) -> None:
    study: Any = SimpleNamespace(name="s", split=None, runs=[run("RL2", 0, 0.1, 0.5), run("RL2", 1, 0.2, 0.7)])
    for each in study.runs:
        each.path = tmp_path / "data" / "s.json"
    folder = tmp_path / "validity"
    with pytest.raises(BidexError, match="bidex-meta validity"):
        list(adaptation_table(study))
    folder.mkdir()
    (folder / f"{SUITE}.json").write_text(json.dumps({"classes": {"Door": {"blind": 0.25}}}))
    head, _, row, mean = adaptation_table(study)
    assert cells(head) == ["class", "blind at best", "before", "after 1", "above blind"]
    assert cells(row) == ["Door", "25.0 %", "15 % (10 to 20)", "60 % (50 to 70)", "+35"]
    assert cells(mean)[1:] == cells(row)[1:]
    study.split = "others"
    with pytest.raises(BidexError, match="no meta-test of others"):
        list(adaptation_table(study))
    study.split = None
    study.runs[1].content["config"]["gamma"], study.runs[0].content["config"]["gamma"] = 0.1, 0.9
    with pytest.raises(BidexError, match=r"gamma is 0\.1 and 0\.9"):
        list(adaptation_table(study))


def test_runs_that_are_no_seeds_of_one_setting_are_not_pooled() -> None:
    with pytest.raises(BidexError, match="both seed 1 of the arm 'b on"):
        table(*learners(), run("b", 1, 0.1, 0.2, 0.3))
    runs = [*learners(), run("another blind", 3, 0.1)]
    for each in runs:
        each.content["config"]["gamma"] = 0.1 if each is runs[-1] else 0.9
    with pytest.raises(BidexError, match=r"blind PPO on .*gamma is 0\.1 and 0\.9"):
        table(*runs)


@pytest.mark.parametrize(
    ("runs", "told"),
    [
        (learners(shown=0.5), "goal-shown PPO reaches 51%"),
        (learners(blind=0.3), "blind PPO reaches 30%, at most 25%"),
        ([each for each in learners() if each.arm in ("ppo", "a", "b")], "1 pairs of reward-only learners"),
        (learners()[:12], "needs 3 seeds of every learner, and some learners have 2"),
        ([run("a", 0, 0.1, 0.2, 0.3)], "not yet judge"),
    ],
)
def test_what_a_suite_lacks_is_told(runs: list[Any], told: str) -> None:
    assert any(told in line for line in table(*runs))


def test_seeds_that_overlap_are_not_separated_and_hidden_rewards_have_a_column() -> None:
    runs = [run("a", seed, 0.1, 0.5, level, hidden=level - 0.2) for seed, level in enumerate((0.5, 0.9, 0.7))]
    runs += [run("b", seed, 0.1, 0.4, level) for seed, level in enumerate((0.6, 0.2, 0.4))]
    lines = table(*runs)
    assert cells(lines[4])[9] == "50 % (30 to 70)" and cells(lines[5])[9] == ""
    assert cells(lines[-1])[-1] == "no"


def test_the_figure_has_a_panel_for_each_suite() -> None:
    study: Any = SimpleNamespace(split=None, runs=[*learners(), run("a", 0, 0.1, 0.2, 0.3, suite="ML1-Other-choice2")])
    assert [axis.get_title() for axis in ladder_figure(study).axes] == [SUITE, "ML1-Other-choice2"]

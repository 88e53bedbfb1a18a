"""``bidex-meta verify``: equal bit for bit, within the intervals, different; and what it cannot compare."""

import json
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from bidex_meta.cli import main
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.agreement import agreements
from bidex_meta.evaluation.results import ClassResult
from bidex_meta.runs import RunFolder


def verify(capsys, *arguments):
    capsys.readouterr()
    code = 0
    try:
        code = main(["verify", *map(str, arguments)])
    except SystemExit as stop:
        code = stop.code
    return code, capsys.readouterr()


def changed(run: Path, change) -> None:
    path = run / "evaluation.json"
    found = json.loads(path.read_text())
    change(found)
    path.write_text(json.dumps(found))


def test_a_run_is_equal_within_or_different(run, capsys):
    code, shown = verify(capsys, run)
    assert code == 0 and "2 classes: 2 equal bit for bit, 0 within, 0 differ" in shown.out and shown.err == ""
    code, shown = verify(capsys, run, "--json")
    found = json.loads(shown.out)
    assert (code, found["equal"], found["steps"], found["conditions"]) == (0, 2, 96, [])

    row = json.loads((run / "evaluation.json").read_text())["policy"]["classes"]["Near"]
    width = row["return_interval"][1] - row["return_interval"][0]
    assert width > 0
    changed(run, lambda found: found["policy"]["classes"]["Near"].update({"return": row["return"] + 0.3 * width}))
    code, shown = verify(capsys, run, "--json")
    assert (code, json.loads(shown.out)["classes"]["Near"]["outcome"]) == (0, "within")
    changed(run, lambda found: found["policy"]["classes"]["Near"].update({"return": row["return"] + 3 * width}))
    code, shown = verify(capsys, run)
    assert code == 1 and "1 differ: this run is not what its evaluation says" in shown.out
    wide = {"return": row["return"] + 9 * width, "return_interval": [-1e9, 1e9]}
    changed(run, lambda found: found["policy"]["classes"]["Near"].update(wide))
    assert verify(capsys, run)[0] == 1


def test_other_tasks_are_verified_and_the_random_policy_is_named(run, capsys):
    assert main(["evaluate", str(run), "--other-tasks", "--random", "--json", "--episodes", "2"]) == 0
    (run / "evaluation.json").write_text(capsys.readouterr().out)
    code, shown = verify(capsys, run)
    assert code == 0 and "4 classes: 4 equal bit for bit" in shown.out and "Far (other tasks)" in shown.out
    assert "Not verified: random policy, means over classes, intervals." in shown.out
    changed(run, lambda found: found["other_tasks"]["policy"]["classes"]["Far"].update({"return": 99.0}))
    code, shown = verify(capsys, run, "--json")
    found = json.loads(shown.out)
    assert (code, found["equal"], found["classes"]["Far (other tasks)"]["outcome"]) == (1, 3, "differs")
    changed(run, lambda found: found["other_tasks"].pop("task_seed"))
    assert "other_tasks.task_seed: expected it to be there" in verify(capsys, run)[1].err


def test_another_policy_is_found(run, capsys):
    checkpoints = RunFolder.open(run).checkpoints
    state, step = checkpoints.load()  # type: ignore[misc]
    weights = state["learner"]["policy"]["weights"]
    for name, weight in weights.items():
        if weight.is_floating_point() and weight.ndim == 2:
            weights[name] = -3.0 * weight
    checkpoints.save(state, step)
    code, shown = verify(capsys, run, "--json")
    assert code == 1, shown
    assert json.loads(shown.out)["differs"] >= 1


def test_conditions_that_changed_are_told(run, capsys):
    then = json.loads((run / "evaluation.json").read_text())["conditions"]
    versions = json.loads((run / "versions.json").read_text())
    assert len(then["physics"]) == 12 and then["physics"] == versions["physics"]
    assert (then["suite_version"], versions["suite_version"], then["device"]) == (1, 1, "cpu")

    def older(found):
        found["conditions"]["packages"]["mujoco"] = "3.9.9"
        found["conditions"] |= {"physics": "0123456789ab", "suite_version": 0, "device": "cuda:0", "engine": "warp"}

    changed(run, older)
    code, shown = verify(capsys, run)
    assert code == 0 and "2 equal" in shown.out
    texts = "mujoco 3.9.9 then, ", "physics 0123456789ab then, ", "suite version 0 then, 1 now", "cuda:0 then, cpu"
    assert all(told in shown.err for told in texts)
    changed(run, lambda found: found.pop("conditions"))  # of an older run: that of versions.json
    (run / "versions.json").write_text(json.dumps({"packages": versions["packages"]}))
    code, shown = verify(capsys, run)
    assert code == 0 and "Conditions: not recorded: physics, suite version." in shown.err


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda found: found.update(steps=95), "no checkpoint of these: its newest is at 96"),
        (lambda found: found.pop("seed"), "seed: expected it to be there"),
        (lambda found: found["policy"].update(episodes_per_task="x"), "episodes_per_task: expected a whole number"),
        (lambda found: found["policy"]["classes"].pop("Near"), "Expected the recorded evaluation to be of Near, Far"),
        (lambda found: found.update(randomisation={}), "expected an evaluation without --randomisation"),
        (lambda found: found["conditions"].update(engine="rust"), "conditions.engine: expected one of auto, c, warp"),
        (lambda found: found.update(splits={"train": {"before": found["policy"], "after": found["policy"]}}), "shots"),
    ],
)
def test_what_cannot_be_compared_is_one_line(run, capsys, change, told):
    changed(run, change)
    code, shown = verify(capsys, run)
    assert code == 2 and told in shown.err and len(shown.err.strip().splitlines()) == 1


def test_no_evaluation_and_another_file(run, capsys, tmp_path):
    (run / "evaluation.json").rename(tmp_path / "kept.json")
    code, shown = verify(capsys, run)
    assert code == 2 and "has no evaluation.json to verify" in shown.err and "evaluate" in shown.err
    assert verify(capsys, run, "--evaluation", tmp_path / "kept.json")[0] == 0
    capsys.readouterr()
    assert main(["evaluate", str(run), "--json", "--num-envs", "12", "--seed", "5", "--episodes", "3"]) == 0
    (run / "evaluation.json").write_text(capsys.readouterr().out)
    code, shown = verify(capsys, run)
    assert code == 0 and "2 equal" in shown.out


def test_a_learner_that_adapts(adapted, tmp_path, capsys):
    path = adapted
    code, shown = verify(capsys, path)
    assert code == 0 and "9 classes: 9 equal bit for bit" in shown.out and "Near (test, shot 1)" in shown.out
    capsys.readouterr()
    words = ["--shots", "2", "--rollouts", "3", "--tasks", "2", "--trials", "2", "--episodes", "5", "--split", "test"]
    assert main(["evaluate", str(path), "--json", *words, "--num-envs", "8"]) == 0
    (tmp_path / "other.json").write_text(capsys.readouterr().out)
    code, shown = verify(capsys, path, "--evaluation", tmp_path / "other.json")
    assert code == 0 and "3 classes: 3 equal bit for bit" in shown.out

    def worse(found):
        found["splits"]["train"]["by_shot"][1]["classes"]["Far"]["return"] -= 100.0

    changed(path, worse)
    code, shown = verify(capsys, path, "--json")
    assert code == 1
    outcomes = {name: row["outcome"] for name, row in json.loads(shown.out)["classes"].items()}
    assert [name for name, outcome in outcomes.items() if outcome == "differs"] == ["Far (train, shot 1)"]


def _rows(generator, classes, episodes, shift=0.0):
    rows = {}
    for i in range(classes):
        returns = generator.normal(5.0 + shift, 2.0, episodes)
        successes = (generator.random(episodes) < 0.3).astype(float)
        result = ClassResult(returns, successes, np.ones(episodes, np.int64), np.zeros(episodes, np.int64), 0)
        rows[f"C{i}"] = result.summary()
    return rows


def test_honest_repetitions_are_within_and_a_worse_policy_is_not():
    """Independent samples are the worst case: of 20 pairs of twenty classes, 60 episodes each, some two have one."""
    generator = np.random.default_rng(0)
    beyond = sum(
        any(each.outcome == "differs" for each in agreements(_rows(generator, 20, 60), _rows(generator, 20, 60)))
        for _ in range(20)
    )
    assert beyond <= 5
    found = agreements(_rows(generator, 20, 60), _rows(generator, 20, 60, shift=2.0))
    assert all(each.outcome == "differs" for each in found)


@pytest.mark.parametrize("name", ["success", "return"])
@pytest.mark.parametrize("tasks", [1, 20])
def test_a_recorded_interval_counts_no_wider_than_episodes_can_make_it(name, tasks):
    again = replace(_rows(np.random.default_rng(2), 1, 60)["C0"], tasks=tasks)
    low, high = getattr(again, f"{name}_interval")
    measure = "mean_return" if name == "return" else name
    for gap, outcome in ((0.3, "within"), (9.0, "differs")):
        value = getattr(again, measure) + gap * (high - low) / 2
        for wide in (1.0, 1e9):
            ends = (value - wide * (high - low) / 2, value + wide * (high - low) / 2)
            row = replace(again, **{measure: value, f"{name}_interval": ends})
            (found,) = agreements({"C0": row}, {"C0": again})
            assert found.outcome == outcome, (gap, wide)


def test_rows_that_cannot_agree():
    rows = _rows(np.random.default_rng(1), 2, 20)
    more = {name: replace(row, episodes=40) for name, row in rows.items()}
    single = {name: replace(row, return_interval=None) for name, row in rows.items()}
    other = {name: replace(row, mean_return=row.mean_return + 1e-6) for name, row in single.items()}
    once = {name: replace(row, success_once=0.1, success_at_end=0.2) for name, row in rows.items()}
    never = {name: replace(row, success_at_end=0.9) for name, row in once.items()}
    scored = {name: replace(row, score=90.0) for name, row in rows.items()}
    rescored = {name: replace(row, score=80.0) for name, row in rows.items()}
    pairs = [((rows, rows), "equal"), ((rows, more), "differs"), ((single, other), "differs")]
    pairs += [((once, once), "equal"), ((never, once), "differs"), ((scored, rescored), "within")]
    for pair, outcome in pairs:
        assert [each.outcome for each in agreements(*pair)] == [outcome] * 2
    with pytest.raises(BidexError, match="of C0, got C0, C1"):
        agreements(rows, {"C0": rows["C0"]})

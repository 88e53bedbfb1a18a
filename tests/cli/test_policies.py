"""From a checkpoint to its policy."""

import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from bidex_meta.cli.looking import looked_at
from bidex_meta.cli.parsing import LookFlags
from bidex_meta.errors import BidexError
from bidex_meta.experiments import recording, run_data
from bidex_meta.experiments.policies import load_checkpoint, policy_of
from bidex_meta.rules import V1, V2
from bidex_meta.runs import RunFolder
from bidex_meta.utils import paths
from bidex_meta.worlds import open_worlds
from tests.fakes import change, trained_run


@pytest.mark.parametrize("run", ["mtppo", "mtsac", "promp", "rl2"])
@pytest.mark.parametrize(
    ("part", "change"),
    [
        ("config", {"hidden": (60_000, 60_000)}),
        ("config", {"hidden": (8,) * 60}),
        ("shape", {"observations": 10**9}),
        ("shape", {"actions": 500}),
    ],
)
def test_a_checkpoint_that_asks_for_more_than_its_weights_takes_no_memory(
    run: str, part: str, change: dict[str, object]
) -> None:
    folder = RunFolder.open(trained_run(run))
    state, _ = load_checkpoint(folder)
    assert policy_of(folder, state, "cpu")
    state["learner"]["policy"][part] |= change
    with pytest.raises(BidexError, match="does not fit its config"):
        policy_of(folder, state, "cpu")


def test_a_policy_in_worlds_of_other_rules_is_noted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "bidex_meta")
    run = trained_run("mtppo")
    own = RunFolder.open(run).config()
    assert own.suite == "MT4"
    own_file = tmp_path / "own.toml"
    text = (paths.suites_dir() / "MT4.toml").read_text()
    own_file.write_text(text.replace('reward = "paper"', 'reward = "paper"\nstarts = "jittered"'))
    told = {None: "", "MT4": "", "MT4-v2": "reward paper, not v2, ", str(own_file): ": starts plain, not jittered."}
    for suite, expected in told.items():
        caplog.clear()
        looked_at(LookFlags(run=run, suite=suite))
        assert all(expected in note and note.startswith("Note: ") for note in caplog.messages)
        assert len(caplog.messages) == bool(expected)
    caplog.clear()
    looked_at(LookFlags(policy="zero", suite="MT4-v2"))
    assert not caplog.messages


def test_a_policy_where_goals_are_shown_that_it_never_saw_is_noted(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "bidex_meta")
    run = trained_run("promp")
    suite = RunFolder.open(run).config().suite
    assert suite is not None
    looked_at(LookFlags(run=run, suite=suite.replace("ML", "MT")))
    assert any(f"learned {suite}, which hides goals; " in note for note in caplog.messages)


def test_a_folder_may_be_called_as_a_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(trained_run("mtppo"), "random")
    assert looked_at(LookFlags(run=Path("random")))[0].name == "MT4"
    assert LookFlags(policy="random").actor == "random"


def test_a_checkpoint_of_a_policy_of_another_shape_is_refused(tmp_path: Path) -> None:
    teachers = paths.suites_dir().parent / "results" / "teachers"
    folder = RunFolder.open(teachers / "CatchUnderarm")
    [own] = folder.checkpoints.folder.glob("*.pt")
    [other] = (teachers / "TwoCatchUnderarm" / "checkpoints").glob("*.pt")
    for file in (str(other), os.path.relpath(other)):
        with pytest.raises(BidexError, match=r"expected a policy of the shape .*422.*, got .*446"):
            load_checkpoint(folder, file)
    for file in (str(own), own.name, os.path.relpath(own)):
        assert load_checkpoint(folder, file)[1] == load_checkpoint(folder)[1]


def test_a_dagger_policy_is_recorded_as_it_acts() -> None:
    for run, expected in ((paths.shipped_policy(), "mean"), (trained_run("mtppo"), "sampled")):
        actor, about = recording._actor(recording.RecordConfig("expert", (run,)), run, "cpu")
        assert (about["actions"], actor.sampled) == (expected, expected == "sampled")


def test_a_run_is_shown_with_its_own_tasks_unless_a_seed_is_named(tmp_path: Path) -> None:
    run = Path(shutil.copytree(trained_run("mtppo"), tmp_path / "run"))
    assert [looked_at(LookFlags(run=run, seed=seed))[0].seed for seed in (None, 0, 5)] == [3, 0, 5]
    change(run, task_seed=7, tasks_per_class=2)
    worlds, *_ = looked_at(LookFlags(run=run))
    assert worlds.seed == 7 and {*worlds.train_tasks().values()} == {2}
    assert {*looked_at(LookFlags(run=run, suite="MT4-v2"))[0].train_tasks().values()} != {2}
    assert looked_at(LookFlags(task="HandOver"))[0].seed == 0


def test_a_class_may_be_named_with_the_version_of_its_suite() -> None:
    assert looked_at(LookFlags(policy="zero", suite="MT4-v2", task="HandOver-v2"))[2] == "HandOver"
    with pytest.raises(BidexError, match="Unknown task of MT4 'HandOver-v2'"):
        looked_at(LookFlags(policy="zero", suite="MT4", task="HandOver-v2"))


def test_data_of_other_rules_are_noted(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "bidex_meta")
    shown = []
    for recorded in ({}, {"rules": vars(V1)}, {"rules": vars(V2)}, {"rules": {"reward": 3}}, {"rules": 3}):
        dataset = SimpleNamespace(name="some/data-v0", metadata=recorded, num_steps=1, num_episodes=1)
        caplog.clear()
        monkeypatch.setattr(run_data, "open_datasets", lambda names, dataset=dataset: [dataset])
        run_data.announced(["some/data-v0"], "Reading", open_worlds({"task": "HandOver-v2"}))
        shown.append(caplog.messages[1:])
    assert shown[0] == shown[2] == shown[4] == [] and len(shown[1]) == len(shown[3]) == 1
    note = "Note: some/data-v0 was recorded by other rules than those of HandOver-v2: reward"
    assert shown[1][0].startswith(f"{note} paper,") and shown[3][0].startswith(f"{note} 3,")

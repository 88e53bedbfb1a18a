"""bidex-meta record demonstrations, and run --demonstrations: one real class, a few episodes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bidex_meta.data import collect, open_dataset, writer
from bidex_meta.experiments import recording
from bidex_meta.runs import RunFolder
from bidex_meta.witness.demonstrators import ShiftedStarts
from bidex_meta.witness.replay import Simulator
from bidex_meta.witness.scripts import SCRIPTS
from bidex_meta.witness.store import load_witness
from bidex_meta.worlds.own import SingleClass
from tests.data.worlds import printed

pytest.importorskip("h5py", reason="needs the extra data")

RECORD = ["record", "demonstrations", "--task", "HandOver", "--num-envs", "3", "--threads", "1", "--noise", "0.02"]
RUN = ["run", "--task", "HandOver", "--base", "moving", "--algo", "ppo", "--num-envs", "50", "--steps", "800"]
RUN += ["--threads", "1", "--device", "cpu", "--logger", "none", "--learner.hidden", "8", "--no-evaluate"]


@pytest.fixture
def sets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("BIDEX_DATA", str(tmp_path / "sets"))
    return tmp_path


def test_the_world_begins_and_goes_as_the_witness_does() -> None:
    name = "HandOver"
    actions = torch.from_numpy(load_witness(name).actions)
    simulator, world = Simulator(name, 1, threads=1), ShiftedStarts(name, 1, 0.0, threads=1)
    trace = simulator.play(actions[:, None])
    first, _ = world.reset(seed=1)
    rewards = [float(world.step(action[None])[4]["reward_unscaled"]) for action in actions]
    assert rewards == pytest.approx(trace.rewards[:, 0].tolist(), abs=1e-6)
    assert torch.equal(world.reset(seed=2)[0], first)
    shifted = ShiftedStarts(name, 3, 0.002, threads=1)
    places = [shifted.reset(seed=seed)[0] for seed in (1, 1, 2)]
    assert torch.equal(places[0], places[1]) and not torch.equal(places[0], places[2])
    assert not torch.equal(places[0][0], places[0][1])
    assert 1e-5 < float((places[0] - first).abs().max()) < 0.05  # of positions; angles in observations stay
    for each in (simulator, world, shifted):
        each.close()


def test_only_what_succeeds_is_kept_and_a_recording_goes_on(
    sets: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "0.00 GB" in printed(capsys, *RECORD, "--size", "300", "--estimate")
    assert not (sets / "sets").exists()
    printed(capsys, *RECORD, "--size", "300")
    whole = open_dataset("HandOver/demonstrations-v0")
    assert whole.num_steps >= 300 and bool(whole.table["success"].all())
    assert (whole.metadata["kind"], whole.metadata["base"]) == ("demonstrations", "moving")
    torn = [*RECORD, "--size", "300", "--out", sets / "sets" / "torn-v0"]
    play, rounds = collect.collect_successes, []

    def once(*given: Any) -> None:
        if rounds:
            raise KeyboardInterrupt
        rounds.append(play(*given))

    with monkeypatch.context() as patch:
        patch.setattr(recording, "collect_successes", once)
        printed(capsys, *torn, code=130)
    asked, room = [], writer.check_room
    with monkeypatch.context() as patch:
        patch.setattr(writer, "check_room", lambda *given: (asked.append(given[1]), room(*given)))
        printed(capsys, *torn)
        printed(capsys, *RECORD, "--size", "300", "--out", sets / "sets" / "fresh-v0")
    assert 0 <= asked[0] < asked[1]  # less what the killed one left
    again = open_dataset("torn-v0").transitions()
    assert all(np.array_equal(a, again[name]) for name, a in whole.transitions().items())
    assert "rewards computed again" in printed(capsys, "data", "check", whole.name)
    # With this much noise the witness fails.
    told_of = printed(capsys, *RECORD, "--noise", "3", "--out", sets / "sets" / "wild-v0", code=2)
    assert "None of 9 replays of HandOver's witness succeeds" in told_of


def test_on_all_tasks_they_show_more(
    sets: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    played = load_witness("CatchAbreast")
    words = ["record", "demonstrations", "--task", "Switch", "--threads", "1", "--starts", "tasks"]
    with monkeypatch.context() as patch:
        patch.setattr(recording, "load_witness", lambda name: played)
        assert "None of 12 replays" in printed(capsys, *words, "--num-envs", "4", "--size", "10", code=2)
    printed(capsys, *words, "--num-envs", "8", "--size", "1", "--out", sets / "sets" / "own-v0")
    kept = open_dataset("own-v0")
    assert kept.metadata["policies"] == [{"algo": None, "actions": "witness", "noise": 0.0, "starts": "tasks"}]
    assert bool(kept.table["success"].all()) and len(set(kept.table["task_index"])) > 1


def test_a_script_shows_tasks_in_closed_loop(
    sets: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["record", "demonstrations", "--threads", "1", "--script"]
    assert "--starts tasks" in printed(capsys, *words, "--task", "PourWater", code=2)
    words += ["--starts", "tasks", "--num-envs", "2", "--size", "1"]
    assert "Expected a class with a script" in printed(capsys, *words, "--task", "Switch", code=2)
    printed(capsys, *words, "--task", "PourWater", "--out", sets / "sets" / "led-v0")
    kept = open_dataset("led-v0")
    assert kept.metadata["policies"] == [{"algo": None, "actions": "script", "noise": 0.0, "starts": "tasks"}]
    assert bool(kept.table["success"].all())
    monkeypatch.setitem(SCRIPTS, "PourWater", lambda hands: hands.lead((0.0, 0.0, 1.0), (0.0, 0.0, 1.0)))
    told_of = printed(capsys, *words, "--task", "PourWater", "--out", sets / "sets" / "idle-v0", code=2)
    assert "None of 6 episodes of PourWater's scripted policy succeeds" in told_of


def test_a_run_imitates_several_sets_and_is_resumed(
    sets: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    printed(capsys, *RECORD, "--size", "200")
    printed(capsys, *RECORD, "--size", "200", "--seed", "1", "--out", sets / "other")
    names = ["HandOver/demonstrations-v0", str((sets / "other").resolve())]
    shown = ["--demonstrations", names[0], "--demonstrations", sets / "other"]
    count = sum(open_dataset(name).num_steps for name in names)
    assert f"Demonstrations: {count} transitions" in printed(capsys, *RUN, *shown, "--run-dir", sets / "whole")
    printed(capsys, *RUN, *shown, "--steps", "400", "--run-dir", sets / "torn")
    printed(capsys, "run", "--resume", sets / "torn", "--steps", "800", "--no-evaluate")
    printed(capsys, *RUN, "--run-dir", sets / "plain")
    weights = []
    for name in ("whole", "torn", "plain"):
        found = RunFolder.open(sets / name).checkpoints.load()
        assert found is not None
        weights.append(found[0]["learner"]["policy"]["weights"]["actor.log_std"])
    assert torch.equal(weights[0], weights[1]) and not torch.equal(weights[0], weights[2])
    for name in ("whole", "torn"):
        assert list(RunFolder.open(sets / name).config().demonstrations) == names

    # No world is built for learners that cannot imitate.
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a world was made")

    monkeypatch.setattr(SingleClass, "world", refuse)
    wrong = [
        (["--demonstrations", "HandOver/demo-v0"], "Unknown data set 'HandOver/demo-v0'"),
        ([*shown, "--base", "own"], "Add --base moving"),
        ([*shown, "--task", "Switch"], "HandOver"),
        ([*shown, "--algo", "td3"], "td3 does not imitate; --demonstrations goes with mtppo, ppo"),
    ]
    for flags, text in wrong:
        assert text in printed(capsys, *RUN, *flags, "--run-dir", sets / "bad", code=2)
    assert "Name the class" in printed(capsys, "record", "demonstrations", code=2)
    assert "shift" in printed(capsys, *RECORD, "--shift", "1", code=2)
    assert not (sets / "bad").exists()

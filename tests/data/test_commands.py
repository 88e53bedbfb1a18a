"""record, run --record and data, on small worlds and one real one."""

import contextlib
import json
import math
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bidex_meta.cli import main
from bidex_meta.data import Dataset, collect, open_dataset, part_files, writer
from bidex_meta.data.checking import verify
from bidex_meta.data.writer import DatasetWriter, estimated_bytes, finish
from bidex_meta.errors import BidexError
from bidex_meta.experiments import run_recording
from bidex_meta.experiments.run_data import dataset_metadata
from bidex_meta.runs import RunFolder
from bidex_meta.utils import memory
from bidex_meta.worlds import open_worlds
from bidex_meta.worlds.own import OwnSuite
from tests.data.worlds import changed, printed, rough
from tests.pages import ROOT

pytest.importorskip("h5py", reason="needs the extra data")

SMALL = ["--suite", "MT4", "--num-envs", "6", "--threads", "1", "--device", "cpu", "--learner.hidden", "8"]
SMALL += ["--learner.rollout-steps", "4", "--no-evaluate"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("BIDEX_DATA", str(tmp_path / "sets"))
    return tmp_path


@pytest.fixture
def toy(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make = lambda source, split="train", rows=None, mode="DISABLED": rough(rows or 6, mode, seed=source.seed)  # noqa: E731
    monkeypatch.setattr(OwnSuite, "world", make)


@pytest.fixture
def real(folder: Path) -> Dataset:
    """CatchUnderarm, some hundred transitions of uniform actions."""
    flags = ["--size", "300", "--num-envs", "6", "--threads", "1", "--device", "cpu"]
    assert main(["record", "random", "--task", "CatchUnderarm", *flags]) == 0
    return open_dataset("CatchUnderarm/random-v0")


def test_a_real_class_its_rewards_and_a_damaged_copy(real: Dataset, capsys: pytest.CaptureFixture[str]) -> None:
    assert 300 <= real.num_steps < 800 and (real.observation_size, real.action_size) == (422, 52)
    known = real.metadata["references"]["CatchUnderarm"]
    assert known["expert"] > known["random"] and real.metadata["commit"] == real.metadata["versions"]["git"]["commit"]
    found = verify(real)
    assert (found.count, found.recomputed) == (0, {"CatchUnderarm": found.steps}) and max(found.largest.values()) < 1e-5
    info = json.loads(printed(capsys, "data", "info", real.name, "--json"))
    assert info["classes"][0]["steps"] == real.num_steps and 0.5 < info["coverage"]["action_std"] < 0.65
    assert info["coverage"]["constant"]["right_hand"] < 0.1
    assert real.name in printed(capsys, "data", "list")
    assert "rewards computed again" in printed(capsys, "data", "check", real.name)
    most = real.num_episodes // 2 + 1  # every second one, not all
    assert verify(real, most).episodes == math.ceil(real.num_episodes / 2) <= most
    # Each fault is found: observations shifted by a step, a reward of another task, a torn end.
    path = part_files.parts_of(real.folder)[0]
    with changed(path) as file:
        shifted = file["episode_0"]["observations"]
        shifted[1:] = shifted[:-1]
    assert "1 wrong" in printed(capsys, "data", "check", real.folder.parent, code=1)
    with changed(path) as file:
        file["table"]["variation"][1, 1] += 0.02
        file["episode_2"]["truncations"][0] = True
    wrong = verify(real).wrong
    assert "the formula gives" in wrong[0] or "the formula gives" in wrong[1]
    fresh = verify(Dataset(real.folder, real.content))
    assert fresh.count == 3 and any("not exactly one end" in line for line in fresh.wrong)
    path.write_bytes(path.read_bytes()[:5000])
    assert "is damaged" in printed(capsys, "data", "check", real.name, code=2)
    path.unlink()
    assert "Parts are missing" in printed(capsys, "data", "info", real.name, code=2)


def recorded(folder: Path, **config: Any) -> Dataset:
    """Uniform actions in two rows of what a config names."""
    source = open_worlds({"seed": 0, "threads": 1, **config})
    world, out = source.world("train", 2), DatasetWriter(folder)
    try:
        collect.collect(world, [collect.Actor(None)], out, 60, 0, lambda now, seconds: None)
        about = dataset_metadata(source, world, "random", [])
        finish(folder, "own/random-v0", world.single_observation_space, world.single_action_space, about)
    finally:
        world.close()
    return open_dataset(folder)


def test_rewards_of_clouds_are_not_computed_again_and_no_episode_is_wrong(tmp_path: Path) -> None:
    """The egg's entries are zero there: the formula has no place to read."""
    found = verify(recorded(tmp_path, task="HandOver", points=16))
    assert (found.count, found.recomputed) == (0, {})
    assert found.skipped == {"HandOver": "its formula asks for object/position, which no observation shows"}


def test_rewards_of_a_suite_with_bases_alone_are_computed_again(tmp_path: Path) -> None:
    """Its HandOver has fixed ones, which nothing but the number of actions tells once the file is gone."""
    text = (ROOT / "suites" / "MT4.toml").read_text().replace('base = "moving"', 'base = "alone"')
    (tmp_path / "own.toml").write_text(text.split("[[classes]]")[0] + '[[classes]]\nname = "HandOver"\n')
    dataset = recorded(tmp_path / "a", suite=str(tmp_path / "own.toml"))
    (tmp_path / "own.toml").unlink()
    found = verify(dataset)
    assert (dataset.action_size, found.count, found.recomputed) == (40, 0, {"HandOver": found.steps})
    # This class has another number of actions.
    dataset.metadata["base"] = "moving"
    found = verify(dataset)
    assert (found.count, found.skipped) == (0, {"HandOver": "HandOver has 52 actions here, the data 40"})


def test_the_four_kinds_of_a_suite(toy: None, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a", "b"):
        assert main(["run", *SMALL, "--steps", "240", "--record", "80", "--run-dir", str(folder / name)]) == 0
    runs, few = [str(folder / "a"), str(folder / "b")], ["--num-envs", "6", "--size", "150", "--threads", "1"]
    assert "Left out" in printed(capsys, "record", "random", "--suite", "mt4", *few)
    printed(capsys, "record", "medium", runs[0], *few)
    printed(capsys, "record", "medium-expert", *runs, *few)
    printed(capsys, "record", "replay", runs[0])
    sets = {kind: open_dataset(f"MT4/{kind}-v0") for kind in ("random", "medium", "medium-expert", "replay")}
    assert {name: found.metadata["kind"] for name, found in sets.items()} == {name: name for name in sets}
    assert all(found.num_steps >= 150 for name, found in sets.items() if name != "replay")
    acted = sets["medium"].metadata["policies"][0]
    assert (acted["run"], acted["actions"], acted["steps"], acted["algo"]) == ("a", "sampled", 240, "mtppo")
    mixed = sets["medium-expert"].table
    assert abs(mixed["steps"][mixed["policy"] == 0].sum() - mixed["steps"].sum() / 2) < 20
    # A third of the rows is recorded: a third of 240 steps, less the episodes that had not ended.
    assert 60 < sets["replay"].num_steps <= 80 and set(sets["replay"].table["row"]) == {0, 3}
    assert sets["replay"].num_steps == open_dataset(folder / "a" / "replay").num_steps
    assert "holds a complete data set" in printed(capsys, "record", "replay", runs[0], code=2)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_of_two_recorders_at_once_one_is_refused(toy: None, folder: Path) -> None:
    """Before it touches anything: the other one's set is whole."""
    words = ["record", "random", "--suite", "MT4", "--size", "300", "--num-envs", "6", "--threads", "1", "--out"]
    for number in range(3):
        out, (start, go), children = folder / f"set-{number}", os.pipe(), []
        for name in "ab":
            if child := os.fork():
                children.append(child)
                continue
            code = 70
            with (folder / name).open("w") as said, contextlib.redirect_stderr(said):
                os.close(go)
                os.read(start, 1)  # until the parent lets both go
                with contextlib.suppress(BaseException):
                    code = main([*words, str(out)])
            os._exit(code)
        os.close(go)
        codes = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
        os.close(start)
        assert sorted(codes) == [0, 2], [(folder / name).read_text() for name in "ab"]
        (line,) = (folder / "ab"[codes.index(2)]).read_text().splitlines()
        assert "Another process records into" in line or "holds a complete data set" in line
        found = verify(open_dataset(out))
        assert found.count == 0 and found.steps >= 300 and not list((out / "data").glob(".*"))


def test_a_resumed_run_records_as_one_that_was_not_ended(toy: None, folder: Path) -> None:
    flags = [*SMALL, "--record", "200"]
    assert main(["run", *flags, "--steps", "240", "--run-dir", str(folder / "whole")]) == 0
    # The rows follow from the number of steps that was first requested.
    stop = ["--evaluate-every", "1", "--stop-at-return", "-1e9"]
    assert main(["run", *flags, "--steps", "240", "--run-dir", str(folder / "torn"), *stop]) == 0
    assert open_dataset(folder / "torn" / "replay").num_steps < 60
    torn = ["--resume", str(folder / "torn"), "--no-evaluate", "--stop-at-return", "1e9"]
    assert main(["run", *torn]) == 0
    assert main(["run", *torn, "--steps", "300"]) == 0
    assert main(["run", "--resume", str(folder / "whole"), "--no-evaluate", "--steps", "300"]) == 0
    a, b = (open_dataset(folder / name / "replay") for name in ("whole", "torn"))
    assert a.num_steps == b.num_steps > 100
    assert all(np.array_equal(x, y) for x, y in zip(a.transitions().values(), b.transitions().values(), strict=True))


def test_a_recorded_run_asks_for_memory_and_for_the_rest_of_the_room(folder, monkeypatch):
    """Of a share of the rows, with a checkpoint's copy; of a resumed run less the parts that are there."""
    config: Any = SimpleNamespace(record=100, record_share=0.5, steps=600)
    asked: list[int] = []
    said: list[str] = []
    monkeypatch.setattr(writer, "check_room", lambda where, needed, what: asked.append(needed))
    # Two rows of five steps, two of eight, of three observations, two actions and two rewards; and once more.
    needed = 2 * 4 * (3 + 2 + 2) * (2 * 5 + 2 * 8)
    monkeypatch.setattr(memory, "available", lambda: needed)
    assert len(run_recording.recorded(config, folder / "run", rough(6)).rows) == 4
    monkeypatch.setattr(memory, "available", lambda: needed - 1)
    with pytest.raises(BidexError, match=r"running episodes of 4 recorded rows .* Lower --record or --num-envs"):
        run_recording.recorded(config, folder / "run", rough(6))
    part = part_files.part_path(folder / "run" / "replay" / "data", 0, 0)
    part.parent.mkdir(parents=True)
    part.write_bytes(bytes(1000))
    with pytest.raises(BidexError, match="running episodes"):
        run_recording.recorded(config, folder / "run", rough(6))
    assert asked[0] == asked[1] == asked[2] + 1000
    # At least one row of each class is recorded, whatever the share; the size is that of these rows.
    config.record_share = 1e-9
    monkeypatch.setattr(memory, "available", lambda: 10 * needed)
    monkeypatch.setattr(run_recording, "say", said.append)
    assert len(run_recording.recorded(config, folder / "other", rough(6)).rows) == 2
    assert asked[3] == estimated_bytes(200, 3, 2, 20.0) and "2 of 6 environments: about 200 transitions" in said[0]


def test_stopping_at_a_return(toy: None, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = printed(capsys, "run", *SMALL, "--steps", "2400", "--run-dir", folder / "r", "--stop-at-return", "-1e9")
    assert "Enough: Train/mean_return is" in said
    steps = [json.loads(line)["step"] for line in (folder / "r" / "metrics.jsonl").read_text().splitlines()]
    episodes = [row["Train/episodes"] for row in RunFolder.open(folder / "r").metrics()]
    assert episodes[-2] < 100 <= episodes[-1] and steps[-1] < 2400
    assert RunFolder.open(folder / "r").goal == steps[-1]
    # A run that was killed before its evaluation was written is evaluated and not trained further.
    said = printed(capsys, "run", "--resume", folder / "r", "--episodes", "1")
    assert "Enough: Train/mean_return is" in said and RunFolder.open(folder / "r").evaluation().steps == steps[-1]
    assert [row["step"] for row in RunFolder.open(folder / "r").metrics()] == steps
    assert "Add for example --evaluate-every" in printed(capsys, "run", *SMALL, "--stop-at-score", "33", code=2)
    assert "--stop-at-success" in printed(capsys, "run", *SMALL, "--stop-at-success", "80", code=2)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("record random", "either --suite SUITE or --task TASK"),
        ("record random --suite MT4 --task HandOver", "either --suite SUITE or --task TASK"),
        ("record rundom --task HandOver", "Did you mean 'random'"),
        ("record medium", "takes 1 run folder, got 0"),
        ("record medium-expert a", "takes 2 run folders, got 1"),
        ("record medium a --suite MT4", "Leave --suite and --task out"),
        ("record random --suite MT4 --base fixed", "goes with --task"),
        ("record random --suite MT4 --checkpoint best", "--checkpoint has no effect in record random. Leave it out."),
        ("record random --suite MT4 --actions mean", "--actions has no effect"),
        ("record random --suite MT4 --noise 0.5", "--noise has no effect"),
        ("record random --suite MT4 --shift 0.01", "--shift has no effect"),
        ("record random --suite MT4 --starts tasks", "--starts has no effect"),
        ("record medium a --shift 0.01", "--shift has no effect in record medium"),
        ("record replay a --size 10", "--size has no effect in record replay"),
        ("record replay a --seed 1", "--seed has no effect"),
        ("record replay a --num-envs 2", "--num-envs has no effect"),
        ("record demonstrations --task Switch --checkpoint best", "--checkpoint has no effect"),
        ("record demonstrations --task Switch --starts tasks --shift 0.01", "no effect with --starts tasks"),
        ("record random --suite MT4 --noise -1", "noise"),
        ("record random --suite MT4 --noise nan", "noise"),
        ("record random --suite MT4 --size -1", "--size"),
        ("record medium nowhere", "is not a run folder"),
        ("record random --task HandOver --size 1e11 --num-envs 2", "are free at"),
        ("data list MT4", "takes no name"),
        ("data info", "needs the name"),
        ("data look x", "Unknown data command"),
        ("data info nothing-v0", "Unknown data set"),
        ("data info a --episodes 3", "goes with check"),
    ],
)
def test_bad_input_is_one_line(words: str, said: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = printed(capsys, *words.split(), code=2)
    assert said in out.splitlines()[-1]
    assert not (folder / "sets").exists()


def test_names() -> None:
    for subject, name in (
        ("CatchUnderarm", "CatchUnderarm/random-v0"),
        ("metaworld/MT10", "metaworld/MT10/random-v0"),
        ("/home/me/my suite.toml", "my-suite/random-v0"),
        ("my_tasks:SlideBlock", "SlideBlock/random-v0"),
    ):
        assert writer.default_name(subject, "random") == name
        writer.check_name(name)
    for name in ("a b-v0", "a"):
        with pytest.raises(BidexError, match="Expected a name such as"):
            writer.check_name(name)


def test_without_h5py_it_is_said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    with pytest.raises(BidexError, match=r"pip install 'bidex-meta\[data\]'"):
        part_files.hdf5()
    assert "bidex-meta[data]" in printed(capsys, "record", "random", "--task", "HandOver", code=2)


def test_estimates(real: Dataset) -> None:
    mean: Any = real.num_steps / real.num_episodes
    size = sum(path.stat().st_size for path in part_files.parts_of(real.folder))
    assert 0.9 < estimated_bytes(real.num_steps, 422, 52, mean) / size < 1.1

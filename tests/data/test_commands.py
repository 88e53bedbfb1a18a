"""record, run --record and data, on small worlds and one real one."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bidex_meta.cli import main
from bidex_meta.data import Dataset, open_dataset, part_files, place
from bidex_meta.data.checking import verify
from bidex_meta.errors import BidexError
from bidex_meta.record import RunFolder
from bidex_meta.sources.source import OwnSuite
from tests.data.worlds import rough

h5py = pytest.importorskip("h5py", reason="needs the extra data")

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


def told(capsys: pytest.CaptureFixture[str], *words: object, code: int = 0) -> str:
    capsys.readouterr()
    try:
        assert main([str(word) for word in words]) == code
    except SystemExit as end:
        assert end.code == code
    out = capsys.readouterr()
    return out.out + out.err


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
    assert (
        found.count == 0
        and found.recomputed == {"CatchUnderarm": found.steps}
        and found.largest["CatchUnderarm"] < 1e-5
    )
    info = json.loads(told(capsys, "data", "info", real.name, "--json"))
    assert info["classes"][0]["steps"] == real.num_steps and 0.5 < info["coverage"]["action_std"] < 0.65
    assert info["coverage"]["constant"]["right_hand"] < 0.1
    assert real.name in told(capsys, "data", "list")
    assert "rewards computed again" in told(capsys, "data", "check", real.name)
    # Observations shifted by a step, a reward of another task, a torn end: each is seen.
    path = part_files.parts_of(real.folder)[0]
    with h5py.File(path, "r+") as file:
        shifted = file["episode_0"]["observations"]
        shifted[1:] = shifted[:-1]
    assert "1 wrong" in told(capsys, "data", "check", real.folder.parent, code=1)
    with h5py.File(path, "r+") as file:
        file["table"]["variation"][1, 1] += 0.02
        file["episode_2"]["truncations"][0] = True
    wrong = verify(real).wrong
    assert "the formula gives" in wrong[0] or "the formula gives" in wrong[1]
    fresh = verify(Dataset(real.folder, real.content))
    assert fresh.count == 3 and any("not exactly one end" in line for line in fresh.wrong)
    path.write_bytes(path.read_bytes()[:5000])
    assert "is damaged or no part" in told(capsys, "data", "check", real.name, code=2)
    path.unlink()
    assert "Parts are missing" in told(capsys, "data", "info", real.name, code=2)


def test_the_four_kinds_of_a_suite(toy: None, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a", "b"):
        assert main(["run", *SMALL, "--steps", "240", "--record", "80", "--run-dir", str(folder / name)]) == 0
    runs, few = [str(folder / "a"), str(folder / "b")], ["--num-envs", "6", "--size", "150", "--threads", "1"]
    assert "Left out" in told(capsys, "record", "random", "--suite", "mt4", *few)
    told(capsys, "record", "medium", runs[0], *few)
    told(capsys, "record", "medium-expert", *runs, *few)
    told(capsys, "record", "replay", runs[0])
    sets = {kind: open_dataset(f"MT4/{kind}-v0") for kind in ("random", "medium", "medium-expert", "replay")}
    assert {name: found.metadata["kind"] for name, found in sets.items()} == {name: name for name in sets}
    assert all(found.num_steps >= 150 for name, found in sets.items() if name != "replay")
    acted = sets["medium"].metadata["policies"][0]
    assert (acted["run"], acted["actions"], acted["steps"], acted["algo"]) == ("a", "sampled", 240, "mtppo")
    mixed = sets["medium-expert"].table
    assert abs(mixed["steps"][mixed["policy"] == 0].sum() - mixed["steps"].sum() / 2) < 20
    # Of a third of the rows: a third of 240 steps, less the episodes that had not ended.
    assert 60 < sets["replay"].num_steps <= 80 and set(sets["replay"].table["row"]) == {0, 3}
    assert sets["replay"].num_steps == open_dataset(folder / "a" / "replay").num_steps
    assert "holds a complete data set" in told(capsys, "record", "replay", runs[0], code=2)


def test_a_resumed_run_records_as_one_that_was_not_ended(toy: None, folder: Path) -> None:
    flags = [*SMALL, "--record", "200"]
    assert main(["run", *flags, "--steps", "240", "--run-dir", str(folder / "whole")]) == 0
    # The rows follow from the steps that were first asked for.
    assert main(["run", *flags, "--steps", "240", "--run-dir", str(folder / "torn"), "--stop-at-return", "-1e9"]) == 0
    assert open_dataset(folder / "torn" / "replay").num_steps < 60
    torn = ["--resume", str(folder / "torn"), "--no-evaluate", "--stop-at-return", "1e9"]
    assert main(["run", *torn]) == 0
    assert main(["run", *torn, "--steps", "300"]) == 0
    assert main(["run", "--resume", str(folder / "whole"), "--no-evaluate", "--steps", "300"]) == 0
    a, b = (open_dataset(folder / name / "replay") for name in ("whole", "torn"))
    assert a.num_steps == b.num_steps > 100
    assert all(np.array_equal(x, y) for x, y in zip(a.transitions().values(), b.transitions().values(), strict=True))


def test_stopping_at_a_return(toy: None, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = told(capsys, "run", *SMALL, "--steps", "2400", "--run-dir", folder / "r", "--stop-at-return", "-1e9")
    assert "Enough: Train/mean_return is" in said
    steps = [json.loads(line)["step"] for line in (folder / "r" / "metrics.jsonl").read_text().splitlines()]
    assert 24 <= steps[-1] < 100
    assert RunFolder.open(folder / "r").goal == steps[-1]
    # Killed before its evaluation was written, it is evaluated and not trained further.
    said = told(capsys, "run", "--resume", folder / "r", "--episodes", "1")
    assert "Enough: Train/mean_return is" in said and RunFolder.open(folder / "r").evaluation()["steps"] == steps[-1]
    assert [row["step"] for row in RunFolder.open(folder / "r").metrics()] == steps
    assert "Add --evaluate-every" in told(capsys, "run", *SMALL, "--stop-at-score", "33", code=2)


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
        ("record random --suite MT4 --noise -1", "--noise must lie in"),
        ("record random --suite MT4 --noise nan", "--noise must be a finite number"),
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
    out = told(capsys, *words.split(), code=2)
    assert said in out.splitlines()[-1]
    assert not (folder / "sets").exists()


def test_names() -> None:
    for subject, name in (
        ("CatchUnderarm", "CatchUnderarm/random-v0"),
        ("metaworld/MT10", "metaworld/MT10/random-v0"),
        ("/home/me/my suite.toml", "my-suite/random-v0"),
        ("my_tasks:SlideBlock", "SlideBlock/random-v0"),
    ):
        assert place.default_name(subject, "random") == name and place.valid_name(name)
    assert not place.valid_name("a b-v0") and not place.valid_name("a")


def test_without_h5py_it_is_said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    with pytest.raises(BidexError, match=r"pip install 'bidex-meta\[data\]'"):
        part_files.hdf5()
    assert "bidex-meta[data]" in told(capsys, "record", "random", "--task", "HandOver", code=2)


def test_estimates(real: Dataset) -> None:
    from bidex_meta.data.writer import estimated_bytes

    mean: Any = real.num_steps / real.num_episodes
    size = sum(path.stat().st_size for path in part_files.parts_of(real.folder))
    assert 0.9 < estimated_bytes(real.num_steps, 422, 52, mean) / size < 1.1

"""Held-out classes: the suite's own form, demonstrations, the runs of each start, tables of what is done."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

from bidex_meta.benchmark import Benchmark
from bidex_meta.cli import main
from bidex_meta.cli import submit as submit_command
from bidex_meta.data import Episode, open_dataset, part_files
from bidex_meta.data.writer import DatasetWriter, finish
from bidex_meta.errors import BidexError
from bidex_meta.evaluation import entries, statistics
from bidex_meta.evaluation.entry_rows import class_row
from bidex_meta.evaluation.leaderboard import read_entry, sealed
from bidex_meta.evaluation.transfer_measures import at_the_end
from bidex_meta.experiments import submitting_transfer, transferring
from bidex_meta.experiments.evaluating import FinalEvaluation
from bidex_meta.experiments.run_config import resolve
from bidex_meta.experiments.sweep_progress import state_of
from bidex_meta.experiments.transfer_plan import (
    Arm,
    arms_of,
    cells_of,
    demonstrations_of,
    evaluate_every,
    held_out,
    some_of,
    suite_file,
)
from bidex_meta.rules import V2, Rules, plain_name
from bidex_meta.runs import RunFolder
from bidex_meta.runs.checkpoints import weights_digest
from bidex_meta.suite_files import load_suite
from bidex_meta.worlds import WorldsConfig, open_worlds
from bidex_meta.worlds.own import OwnSuite
from tests.cli.conftest import toy
from tests.data.worlds import ABOUT
from tests.fakes import SLOT_TASKS, run_config

SUITE = """
name = "pair"
version = 3
kind = "meta"
description = "Two classes to train on, one to test on"
observation = "masked"
task_id = "class"
reward = "v2"
variation = "wide"
success = "at-end"
starts = "jittered"
base = "moving"
tasks_per_class = 2
classes = [
    { name = "PourWater", options = { water = 3 }, gamma = 0.9 },
    { name = "TwoCatchUnderarm" },
    { name = "DoorCloseOutward", split = "test", reward_scale = 0.5 },
]
"""


def opened(suite: str | Path, seed: int = 0) -> Any:
    return open_worlds(WorldsConfig(suite=str(suite), seed=seed, threads=1))


@pytest.fixture
def pair(tmp_path: Path) -> Path:
    (tmp_path / "pair.toml").write_text(SUITE)
    return tmp_path / "pair.toml"


def test_a_class_is_trained_on_as_the_meta_test_has_it(pair: Path, tmp_path: Path) -> None:
    """The same tasks, padding and hidden goals; what is left of the suite is as in its file."""
    here = opened(suite_file(opened(pair, seed=5), "DoorCloseOutward", tmp_path))
    there = Benchmark(pair, seed=5)
    assert here.benchmark.train_tasks == there.test_tasks and here.hides_goals
    assert here.benchmark.padded_size == there.padded_size > here.task_classes()["DoorCloseOutward"].observation_size
    ours, suite = here.suite, load_suite(pair)
    assert ours and (ours.name, ours.version, ours.rules) == ("pair-DoorCloseOutward", 3, suite.rules)
    assert (ours.observation, ours.task_id, ours.base) == (suite.observation, suite.task_id, suite.base)
    *others, door = ours.classes
    assert tuple(replace(entry, splits=("train",)) for entry in others) == suite.classes[:-1]
    assert door.splits == ("train",) and replace(door, splits=("test",), tasks=()) == suite.classes[-1]


@pytest.mark.parametrize("name", ["ML4-v2", "ML20-v2"])
def test_held_out_classes_of_the_shipped_suites(name: str, tmp_path: Path) -> None:
    worlds = opened(name)
    classes = held_out(worlds, [])
    assert (
        classes == [plain_name(each) for each in Benchmark(name).test_classes]
        and held_out(worlds, [classes[-1].lower()]) == classes[-1:]
    )
    here = opened(suite_file(worlds, classes[0], tmp_path))
    assert list(here.tasks("train")) == classes[:1] and len(here.tasks("train")[classes[0]]) == 50
    assert here.benchmark.train_tasks == Benchmark(name).tasks_of(classes[0], "test")


def test_other_tasks_in_the_same_folder_are_refused(pair: Path, tmp_path: Path) -> None:
    assert suite_file(opened(pair), "DoorCloseOutward", tmp_path) == suite_file(
        opened(pair), "DoorCloseOutward", tmp_path
    )
    with pytest.raises(BidexError, match="is of other tasks"):
        suite_file(opened(pair, seed=1), "DoorCloseOutward", tmp_path)


def test_points_and_objects_of_a_suite_are_kept(pair: Path, tmp_path: Path) -> None:
    thrown = '{ name = "CatchUnderarm", split = "test", objects = ["mug", "block"] },\n]'
    more = "points = { count = 32, kinds = true }\ntouch = true\nrandomisation = { friction = [0.5, 1.5] }\n"
    pair.write_text(SUITE.replace("]\n", f"    {thrown}\n{more}"))
    suite = opened(suite_file(opened(pair), "CatchUnderarm-mug", tmp_path)).suite
    assert suite and suite.randomisation == load_suite(pair).randomisation is not None
    assert (suite.points, suite.point_kinds, suite.touch) == (32, True, True)
    assert [entry.name for entry in suite.split_classes("train")] == ["CatchUnderarm-mug"]
    assert [entry.name for entry in suite.split_classes("test")][-1] == "CatchUnderarm-block"


def demonstrations(folder: Path, success: str = "1101", rules: Rules | None = V2) -> Path:
    """A data set of a class alone; episode n is of n + 1 steps."""
    writer = DatasetWriter(folder)
    for number, solved in enumerate(success):
        steps, last = number + 1, np.arange(number + 1) == number
        states, actions = np.zeros((steps + 1, 5), np.float32), np.zeros((steps, 2), np.float32)
        rewards, never = np.ones(steps, np.float32), np.zeros(steps, bool)
        writer.add(Episode(states, actions, rewards, last, never, success=solved == "1"))
    writer.commit()
    about = ABOUT | {"tasks": ["DoorCloseOutward-v2"], "reward_scales": {}, "observation_groups": [["state", [[0, 5]]]]}
    about |= {} if rules is None else {"rules": asdict(rules)}
    finish(folder, folder.name, Box(-9.0, 9.0, (5,)), Box(-1.0, 1.0, (2,)), about)
    return folder


def test_fewer_demonstrations_are_among_more_and_all_have_succeeded(tmp_path: Path) -> None:
    pytest.importorskip("h5py", reason="needs the extra data")
    dataset = open_dataset(demonstrations(tmp_path / "all-v0", success="110111011"))

    def drawn(count: int, seed: int) -> list[int]:
        found = open_dataset(some_of(dataset, "DoorCloseOutward", count, seed, tmp_path))
        assert found.metadata["tasks"] == ["DoorCloseOutward"] and found.num_episodes == count
        return [len(episode) for episode in found.episodes()]

    by_count = [{*drawn(count, seed=0)} for count in (1, 3, 7)]
    assert all(fewer < more for fewer, more in pairwise(by_count)) and by_count[-1] == {1, 2, 4, 5, 6, 8, 9}
    assert drawn(3, seed=0) == drawn(3, seed=0) and len({tuple(drawn(3, seed)) for seed in range(5)}) > 1
    with pytest.raises(BidexError, match="Expected 8 successful episodes of DoorCloseOutward, found 7 in all-v0"):
        some_of(dataset, "DoorCloseOutward", 8, 0, tmp_path)
    other = open_dataset(demonstrations(tmp_path / "other-v0"))
    with pytest.raises(BidexError, match="was drawn from"):
        some_of(other, "DoorCloseOutward", 3, 0, tmp_path)


def test_a_policy_is_cloned_from_one_episode_of_a_script(pair: Path, tmp_path: Path) -> None:
    """For real: the data go into the suite's form, and the run ends with its evaluation."""
    pytest.importorskip("h5py", reason="needs the extra data")
    file = suite_file(opened(pair), "DoorCloseOutward", tmp_path)
    found = demonstrations_of(file, "DoorCloseOutward", [], tmp_path, 1)
    usual = replace(transferring.USUAL_RUN, suite=str(file), num_envs=2, device="cpu", threads=1)
    config = resolve(replace(usual, learner={"demonstration_cloning": 20}))
    (tmp_path / "data").mkdir()
    fresh = Arm("nothing", None, {"hidden": [8]})
    final = FinalEvaluation(episodes=1)
    (cell,) = cells_of(config, final, file, "DoorCloseOutward", [fresh], tmp_path, 0, [1], found)
    assert cell.run.config.demonstrations == (str(tmp_path / "data" / "DoorCloseOutward-1-seed0-v0"),)
    assert main(list(cell.run.begin)) == 0 and state_of(cell.run).state == "done"
    assert len(at_the_end([cell.run.folder])["success"]["of_seeds"]) == 1
    state = cell.run.folder.checkpoints.load()
    assert state and state[0]["learner"]["policy"]["weights"]["observations.stats.count"].max() == 250, (
        "of the episode alone"
    )


def test_scripts_demonstrate_where_no_data_are_given(pair: Path, tmp_path: Path) -> None:
    pytest.importorskip("h5py", reason="needs the extra data")
    file = suite_file(opened(pair), "DoorCloseOutward", tmp_path)
    found = demonstrations_of(file, "DoorCloseOutward", [], tmp_path, 1)
    assert found and found.num_episodes and found.table["success"].all() and found.metadata["hides_goals"]
    again = demonstrations_of(file, "DoorCloseOutward", [], tmp_path, 1)
    assert again and again.folder == found.folder, "not recorded again"
    given = demonstrations(tmp_path / "mine-v0")
    own = demonstrations_of(file, "DoorCloseOutward", [str(given)], tmp_path, 1)
    assert own and own.folder == given / "data"
    with pytest.raises(BidexError, match="has DoorCloseOutward with other rules than pair-DoorCloseOutward"):
        demonstrations_of(file, "DoorCloseOutward", [str(demonstrations(tmp_path / "v1-v0", rules=None))], tmp_path, 1)
    pair.write_text(SUITE.replace("DoorCloseOutward", "CatchAbreast"))
    file = suite_file(opened(pair), "CatchAbreast", tmp_path)
    assert demonstrations_of(file, "CatchAbreast", [str(given)], tmp_path, 1) is None


# The command: real plans, and real runs of PPO on worlds of points.


@pytest.mark.parametrize(("learner", "every"), [({}, 4), ({"rollout_steps": 128}, 1)])
def test_a_run_by_reinforcement_is_evaluated_a_hundred_times_or_after_each_iteration(learner, every) -> None:
    config = resolve(replace(transferring.USUAL_RUN, task="HandOver-v2", num_envs=64, learner=learner))
    assert evaluate_every(250_000, config) == every


FLAGS = ["--steps", "96", "--demonstrations", "0", "--seeds", "2", "--num-envs", "6"]
MORE = ["--", "--episodes", "1", "--device", "cpu", "--learner.critic-first", "12"]


@pytest.fixture(scope="module")
def start(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("trained") / "start"
    words = ["--suite", "ML4-v2", "--algo", "mtppo", "--num-envs", "6", "--steps", "480", "--device", "cpu"]
    words += ["--learner.hidden", "8", "--learner.activation", "tanh", "--threads", "1", "--logger", "none"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OwnSuite, "world", toy)
        assert main(["run", *words, "--no-evaluate", "--run-dir", str(path)]) == 0
    return path


@pytest.fixture
def trained(start: Path, toy_worlds, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A run to start from, and runs within this process."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(statistics, "RESAMPLES", 400)
    shutil.copytree(start, "start")

    def work(runs, cores) -> int:
        return sum(main(list(run.begin)) != 0 for run in runs)

    monkeypatch.setattr(transferring, "work", work)
    yield tmp_path / "start"


def weights(path: Path) -> dict[str, torch.Tensor]:
    loaded = RunFolder.open(path).checkpoints.load()
    assert loaded
    return loaded[0]["learner"]["policy"]["weights"]


def test_all_starts_are_run_once_and_become_tables(trained: Path, tmp_path: Path, shown, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")  # narrower tables leave columns out
    out = shown("transfer", trained, *FLAGS, "--out", "t", *MORE)
    found = json.loads(Path("t/transfer.json").read_text())
    for track in ("reinforcement", "demonstrations"):
        assert [(row["from"], row["seeds"]) for row in found[track]] == [("start", [0, 1]), ("nothing", [0, 1])]
    assert len(found["reinforcement"][0]["area"]["of_seeds"]) == 2
    assert found["reinforcement"][0]["over_nothing"]["interval"] and not found["reinforcement"][1]["over_nothing"]
    runs = sorted(Path("t/runs").iterdir())
    assert len(runs) == 2 * 2 * 2
    config = RunFolder.open(Path("t/runs/TwoCatchUnderarm-nothing-ppo-seed1")).config()
    assert (config.steps, config.evaluate_every, config.seed, config.start_from) == (96, 1, 1, None)
    assert (config.learner_values["hidden"], config.learner_values["critic_first"]) == ([8], 12)
    assert Path(config.suite or "") == tmp_path / "t/suites/ML4-v2-TwoCatchUnderarm.toml"
    assert {path.name for path in Path("t").glob("*.png")} == {"reinforcement.png", "demonstrations.png"}
    monkeypatch.setattr(transferring, "work", lambda runs, cores: pytest.fail("run twice") if runs else 0)
    tables = shown("transfer", trained, *FLAGS, "--out", "t", *MORE)
    assert out.endswith(tables) and tables.count("TwoCatchUnderarm") == 4 and tables.count(" 0, 1 ") == 4
    assert "area over nothing" in tables and "steps to 50 %" in tables and "demonstrations" in tables


def test_a_transfer_is_submitted_and_repeated(trained: Path, shown, refused, monkeypatch) -> None:
    for module in (entries, submitting_transfer):
        monkeypatch.setattr(module, "TRANSFER_STEPS", 96)
        monkeypatch.setattr(module, "held_out", lambda suite: {"TwoCatchUnderarm": sum(SLOT_TASKS)})
    words = [*FLAGS[:2], "--demonstrations", *FLAGS[4:], "--out", "t"]
    ours = ["submit", trained, "--transfer", "t", "--device", "cpu", "--out", "board"]
    shown("transfer", trained, *words, "--seeds", "1", *MORE)
    shutil.move("t/runs/TwoCatchUnderarm-nothing-ppo-seed0", "aside")
    assert "from scratch has the seeds []" in refused(*ours, "--tuning", "1x1")
    shutil.move("aside", "t/runs/TwoCatchUnderarm-nothing-ppo-seed0")
    shown("transfer", trained, *words, *MORE)
    shown(*ours, "--tuning", "1x1")
    path = Path("board/ML4-v2-mtppo-transfer.json")
    entry = read_entry(path)
    assert isinstance(entry, entries.TransferEntry) and (entry.seeds, entry.steps) == ([0, 1], [480])
    run = RunFolder.open("t/runs/TwoCatchUnderarm-start-ppo-seed1")
    loaded = run.checkpoints.load()
    assert loaded and entry.receipt.weights[1] == weights_digest(loaded[0]["learner"]["policy"])
    assert len(entry.new.shots) == 2 and [*entry.new.shots[0]] == ["TwoCatchUnderarm"]
    check = ["submit", "--check", path, trained, "--transfer", "t", "--device", "cpu"]
    assert shown(*check).splitlines()[-1] == f"{path}: equal"
    assert "by --transfer" in refused(*check[:4])
    assert "is already in" in refused(*ours, "--tuning", "1x1", "--name", "other")
    content = json.loads(path.read_text())
    row = content["new"]["shots"][0]["TwoCatchUnderarm"]
    content["new"]["shots"][0]["TwoCatchUnderarm"] = class_row([[0] * 5, [1] * 5], 1)
    assert content["new"]["shots"][0]["TwoCatchUnderarm"] != row
    path.write_text(json.dumps(sealed(content, entries.TransferEntry, "forged")))
    with pytest.raises(SystemExit, match="1"):
        submit_command.main([str(word) for word in check[1:]])


def test_what_no_demonstration_shows_plays_the_policy_itself(trained: Path, shown) -> None:
    shown("transfer", trained, *FLAGS, "--steps", "0", "--seeds", "1", "--out", "t", *MORE[:-2])
    before = weights(trained)
    for name, weight in weights(Path("t/runs/TwoCatchUnderarm-start-0-demonstrations-seed0")).items():
        assert name.endswith("count") or torch.equal(weight, before[name]), name
    assert "reinforcement" not in {path.stem for path in Path("t").glob("*.png")}


def test_a_failed_run_is_left_out_and_tried_again(trained: Path, monkeypatch, shown, capsys) -> None:
    whole = transferring.work
    monkeypatch.setattr(transferring, "work", lambda runs, cores: whole(runs[1:], cores) + 1)
    with pytest.raises(SystemExit, match="1"):
        main(["transfer", str(trained), *FLAGS, "--steps", "0", "--out", "t", *MORE[:-2]])
    assert "1 failed" in capsys.readouterr().err
    first = json.loads(Path("t/transfer.json").read_text())["demonstrations"][0]
    assert (first["from"], first["seeds"]) == ("start", [1])
    monkeypatch.setattr(transferring, "work", whole)
    shown("transfer", trained, *FLAGS, "--steps", "0", "--out", "t", *MORE[:-2])
    assert json.loads(Path("t/transfer.json").read_text())["demonstrations"][0]["seeds"] == [0, 1]


def test_bad_input_is_one_line_and_writes_nothing(trained: Path, tmp_path: Path, refused) -> None:
    for name, fields in (("shown", {"suite": "MT4"}), ("both", {"suite": "ML1"}), ("alone", {"task": "HandOver"})):
        RunFolder.create(run_config(**{"suite": None, **fields}), tmp_path / name)
    RunFolder.create(run_config(suite="ML4-v2"), tmp_path / "nothing")
    RunFolder.create(run_config(suite="ML4-v2"), tmp_path / "others" / "start")
    for words, message in (
        (["shown"], "Expected a run on a suite with classes that are not trained on (ML4-v2, ML20-v2), got one on MT4"),
        (["both"], "got one on ML1"),
        (["alone"], "got one on HandOver"),
        (["elsewhere"], "is not a run folder"),
        (["start", "--classes", "HandOver"], "Unknown held-out class of ML4-v2 'HandOver'"),
        (["nothing"], "Two starts are called nothing"),
        (["start", "--start-from", "others/start"], "Two starts are called start"),
        (["start", "--seeds", "0"], "--seeds"),
        (["start", "--workers", "100000"], "--workers"),
        (["start", "--", "--learner.gama", "1"], "Unknown flag --learner.gama of bidex-meta run"),
        (["start", "--", "--minutes", "1"], "transfer: minutes: expected none, got 1.0"),
        (["start", "--", "--stop-at-success", "0.5"], "transfer: stop_at_success: expected none, got 0.5"),
    ):
        error = refused("transfer", words[0], "--out", "t", *words[1:])
        assert message in error and error.count("\n") == 1 and not Path("t").exists()


def test_each_start_has_the_network_of_its_run(tmp_path: Path) -> None:
    for name, hidden in (("a", [8, 4]), ("b", [16])):
        RunFolder.create(run_config(suite="ML4-v2", learner={"hidden": hidden, "gamma": 0.5}), tmp_path / name)
    arms = arms_of([RunFolder.open(tmp_path / "a"), RunFolder.open(tmp_path / "b")])
    assert [(arm.name, arm.network["hidden"]) for arm in arms] == [("a", [8, 4]), ("nothing", [8, 4]), ("b", [16])]


def test_demonstrations_without_hdf5_are_refused_at_once(trained: Path, refused, monkeypatch) -> None:
    def absent() -> None:
        raise BidexError("Expected h5py for data sets")

    monkeypatch.setattr(part_files, "hdf5", absent)
    assert "h5py" in refused("transfer", trained, "--demonstrations", "1", "--out", "t") and not Path("t").exists()

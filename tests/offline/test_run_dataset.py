"""bidex-meta run --dataset, from recording to evaluation; data sets in the form of a world."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

from bidex_meta.benchmark import Benchmark
from bidex_meta.data import Dataset, open_dataset
from bidex_meta.data.collector import EpisodeCollector
from bidex_meta.data.joined import class_physics, join
from bidex_meta.data.writer import DatasetWriter, begin, finish
from bidex_meta.errors import BidexError
from bidex_meta.experiments.run_data import dataset_metadata, implied
from bidex_meta.runs import RunFolder
from bidex_meta.suite_files import load_suite
from bidex_meta.witness.replay import task_slot
from bidex_meta.world import World, WorldConfig
from bidex_meta.world.contract import ObservationGroup
from bidex_meta.worlds import open_worlds
from bidex_meta.worlds.external import HUMANOID
from bidex_meta.worlds.own import OwnSuite
from tests.algos.problems import opposite_bandits
from tests.data.worlds import printed, rough
from tests.offline.stored import noisy, played

pytest.importorskip("h5py", reason="needs the extra data")

FEW = ["--num-envs", "6", "--threads", "1", "--device", "cpu"]
SMALL = ["--threads", "1", "--device", "cpu", "--learner.hidden", "8", "--learner.updates-per-iteration", "10"]
SMALL += ["--learner.batch-size", "16", "--logger", "none"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("BIDEX_DATA", str(tmp_path / "sets"))
    make = lambda source, split="train", rows=None, mode="DISABLED": rough(rows or 6, mode, seed=source.seed)  # noqa: E731
    monkeypatch.setattr(OwnSuite, "world", make)
    return tmp_path


def test_a_run_on_data_sets_is_evaluated_resumed_and_reported(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for kind, seed in (("a", 0), ("b", 5)):
        more = ["--size", "150", "--seed", seed, "--out", folder / "sets" / f"{kind}-v0"]
        printed(capsys, "record", "random", "--suite", "mt4", *FEW, *more)
    run = ["run", "--dataset", "a-v0", "--dataset", folder / "sets" / "b-v0", "--algo", "iql", "--seed", "3", *SMALL]
    whole, halves = folder / "whole", folder / "halves"
    said = printed(capsys, *run, "--steps", "40", "--evaluate-every", "2", "--run-dir", whole, "--episodes", "1")
    assert "Reading 3" in said and "Evaluating" in said
    again = ["run", "--algo", "iql", "--resume", whole, "--dataset", "a-v0"]
    assert "--dataset is ['a-v0'," in printed(capsys, *again, code=2)
    printed(capsys, *run, "--steps", "20", "--run-dir", halves, "--no-evaluate")
    printed(capsys, "run", "--resume", halves, "--steps", "40", "--no-evaluate")
    config = RunFolder.open(whole).config()
    assert (config.suite, config.task, config.task_seed, config.num_envs) == ("MT4", None, 0, 4)
    assert list(config.dataset) == ["a-v0", str((folder / "sets" / "b-v0").resolve())]
    a, b = (RunFolder.open(name).checkpoints.load()[0]["learner"] for name in (whole, halves))
    for name, weight in a["policy"]["weights"].items():
        assert torch.equal(weight, b["policy"]["weights"][name])
    lines = [json.loads(line) for line in (whole / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [10, 20, 30, 40]
    assert ["Eval/mean_return" in line for line in lines] == [False, True, False, True]
    assert "iql" in printed(capsys, "compare", whole)
    printed(capsys, "plot", whole, "--out", folder / "curves.png")
    assert (folder / "curves.png").stat().st_size > 5000
    printed(capsys, "report", whole, "--out", folder / "report.html")


def test_a_policy_from_data_is_recorded_on_the_tasks_of_its_data(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    printed(capsys, "record", "random", "--suite", "MT4", *FEW, "--size", "60", "--seed", "4")
    runs = [folder / name for name in ("a", "b")]
    for seed, run in enumerate(runs, 1):
        flags = ["--dataset", "MT4/random-v0", "--algo", "bc", "--seed", seed, "--steps", "10", "--run-dir", run]
        printed(capsys, "run", *flags, *SMALL, "--no-evaluate")
    printed(capsys, "record", "medium-expert", *runs, *FEW, "--size", "60", "--seed", "9")
    about = open_dataset("MT4/medium-expert-v0").metadata
    assert (about["seed"], about["starts"]) == (4, 9)


def test_gymnasiums_humanoid_is_learned_without_being_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    few = ["--size", "60", "--num-envs", "4", "--threads", "1", "--device", "cpu"]
    printed(capsys, "record", "random", "--task", HUMANOID, *few)
    name = f"{HUMANOID}/random-v0"
    about = open_dataset(name).metadata
    assert (about["suite"], about["task"], about["base"]) == (None, HUMANOID, "own")
    flags = ["--dataset", name, "--algo", "bc", "--steps", 10, "--no-evaluate", "--run-dir", folder / "a"]
    printed(capsys, "run", *SMALL, *flags)
    assert RunFolder.open(folder / "a").config().task == HUMANOID


def test_what_does_not_go_together_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for suite in ("MT4", "ML4"):
        printed(capsys, "record", "random", "--suite", suite, *FEW, "--size", "60")
    for flags, told in (
        ("--suite MT4 --algo bc", "Add --dataset NAME"),
        ("--dataset MT4/random-v0 --algo mtppo", "goes with bc, bcq, td3bc, iql"),
        ("--dataset MT4/random-v0 --algo bc --record 10", "nothing to record"),
        ("--dataset MT4/random-v0 --algo bc --stop-at-success 0.5", "Add for example --evaluate-every 50"),
        ("--dataset MT4/rand-v0 --algo bc", "Unknown data set 'MT4/rand-v0'. Did you mean"),
        ("--dataset ML4/random-v0 --suite MT4 --algo bc", "ML4/random-v0 hides goals, MT4 shows"),
    ):
        assert told in printed(capsys, "run", *flags.split(), code=2)
    assert "--dataset" in printed(capsys, "run", "--algo", "bc", "--help")
    assert not (folder / "runs").exists()


def stored(folder: Path, name: str, episodes: list[Any], tasks: list[str], **about: Any) -> Dataset:
    begin(folder / name, {"kind": "test"})
    writer = DatasetWriter(folder / name)
    for episode in episodes:
        writer.add(episode)
    writer.commit()
    writer.close()
    shapes = episodes[0].observations.shape[1], episodes[0].actions.shape[1]
    spaces = [Box(-np.inf, np.inf, (size,), np.float32) for size in shapes]
    finish(folder / name, "toy/test-v0", *spaces, {"tasks": tasks, "kind": "test", **about})
    return open_dataset(folder / name)


def alone(slot: int, size: int, actions: int = 2) -> list[Any]:
    world = opposite_bandits(rows=2)
    found = [e for e in played(world, noisy(lambda obs: torch.zeros(len(obs), 2), 0.3), 9) if e.task == slot]
    for episode in found:
        object.__setattr__(episode, "task", 0)
        object.__setattr__(episode, "observations", np.repeat(episode.observations[:, :1], size, 1))
        object.__setattr__(episode, "actions", np.resize(episode.actions, (len(episode), actions)))
    return found


def test_classes_recorded_alone_get_padding_one_hot_and_scale(tmp_path: Path) -> None:
    both, world = [alone(0, 1), alone(1, 3)], opposite_bandits(rows=2)
    world.single_observation_space = Box(-np.inf, np.inf, (5,), np.float32)  # 3 and the one-hot
    plain = SimpleNamespace(touch=False)
    world.slots = [SimpleNamespace(name=f"task{i}", reward_scale=2.0, task_class=plain) for i in (0, 1)]  # type: ignore
    sets = [
        stored(tmp_path, f"{i}-v0", both[i], [f"task{i}"], reward_scales={f"task{i}": 4.0 * i + 1.0}) for i in (0, 1)
    ]
    data = join(sets, world)
    steps = [(slot, each, t) for slot, episodes in enumerate(both) for each in episodes for t in range(len(each))]
    assert len(steps) == len(data)
    for i, (slot, episode, t) in enumerate(steps):
        padded = np.zeros(5, np.float32)
        padded[: 1 + 2 * slot], padded[3 + slot] = episode.observations[t], 1.0
        assert data.observations[data.at[i]].numpy() == pytest.approx(padded)
        assert data.observations[data.at[i] + 1][0] == float(episode.observations[t + 1][0])
        assert float(data.rewards[i]) == pytest.approx(episode.rewards[t] * 2.0 / (4.0 * slot + 1.0))
        assert (int(data.task[i]), int(data.left[i])) == (slot, len(episode) - 1 - t)
    with pytest.raises(BidexError, match="found none of task1"):
        join(sets[:1], world)
    world.single_action_space = Box(-1, 1, (7,), np.float32)
    with pytest.raises(BidexError, match="has 2 actions, the world 7"):
        join(sets, world)
    with pytest.raises(BidexError, match="entries beside the task id"):
        join(sets, opposite_bandits(rows=2))


def test_goals_that_the_world_hides_are_zero_as_it_shows_them(tmp_path: Path) -> None:
    slot = task_slot("Switch")
    given: dict[str, Any] = {"autoreset_mode": "DISABLED", "seed": 3, "threads": 1}
    plain = World([slot], WorldConfig(1, observation="plain", **given))
    masked = World([slot], WorldConfig(1, observation="masked", pad_to=450, **given))
    episodes: list[Any] = []
    recorder = EpisodeCollector(plain, episodes.append)
    seen, action = [masked.reset(seed=3)[0]], torch.full((1, 52), 0.1)
    recorder.reset(seed=3)
    for _ in range(slot.task_class.episode_steps):
        recorder.step(action)
        seen.append(masked.step(action)[0])
    goals = slot.task_class.layout.goal_indices()
    assert episodes[0].observations[:, goals].any()
    shown = stored(tmp_path, "a-v0", episodes, ["Switch"], hides_goals=False)
    masked.num_tasks = 2  # of several classes, whose observations are padded
    assert torch.equal(join([shown], masked).observations, torch.cat(seen))
    plain.close()
    masked.close()


def test_data_of_a_class_of_version_2_are_known_in_suites_of_it_alone(tmp_path: Path) -> None:
    alone = task_slot("Switch-v2")
    of_suite, of_version_1 = replace(alone, name="Switch"), task_slot("Switch")
    made = [
        World([slot], WorldConfig(1, autoreset_mode="DISABLED", threads=1)) for slot in (alone, of_suite, of_version_1)
    ]
    episodes: list[Any] = []
    recorder = EpisodeCollector(made[0], episodes.append)
    recorder.reset(seed=3)
    for _ in range(alone.task_class.episode_steps):
        recorder.step(torch.full((1, 52), 0.1))
    about: dict[str, Any] = {"hides_goals": False, "physics": class_physics([alone])}
    data = stored(tmp_path, "a-v0", episodes, ["Switch-v2"], **about)
    assert torch.equal(join([data], made[0]).observations, join([data], made[1]).observations)
    with pytest.raises(BidexError, match="'Switch-v2'"):
        join([data], made[2])
    for each in made:
        each.close()


def test_data_of_an_object_that_has_changed_are_refused(tmp_path: Path) -> None:
    """By class: the file of the object is the same by its name."""
    text = "<mujoco><worldbody><body><geom type='box' size='0.03 0.03 0.03' mass='0.1'/></body></worldbody></mujoco>"
    (tmp_path / "brick.xml").write_text(text)
    source = open_worlds({"task": "CatchUnderarm", "object": str(tmp_path / "brick.xml"), "threads": 1})
    world = source.world("train", 1)
    about = {name: dataset_metadata(source, world, "random", [])[name] for name in ("tasks", "physics")}
    assert about["physics"] == class_physics(world.slots) and list(about["physics"]) == about["tasks"]
    episodes = alone(1, 422, 52)
    known = stored(tmp_path, "known-v0", episodes, **about)
    older = stored(tmp_path, "older-v0", episodes, about["tasks"])
    assert len(join([known, older], world)) == 2 * known.num_steps
    world.close()
    (tmp_path / "brick.xml").write_text(text.replace("0.1", "0.2"))
    changed = source.world("train", 1)
    assert len(join([older], changed)) == older.num_steps
    with pytest.raises(BidexError, match=r"the physics of CatchUnderarm-brick as recorded .* Restore it, or"):
        join([known], changed)
    changed.close()


def clouds(points: int, state: int, ids: int) -> list[Any]:
    last = state + 3 * points
    found = [["state", [[0, state]]], ["points", [[state, last]]], ["task_id", [[last, last + ids]]]]
    return found if ids else found[:2]


def test_a_class_recorded_alone_keeps_its_cloud_in_its_place(tmp_path: Path) -> None:
    world = opposite_bandits(rows=2)
    world.single_observation_space = Box(-np.inf, np.inf, (3 + 6 + 2,), np.float32)
    world.observation_groups = tuple(
        ObservationGroup(name, tuple(slice(*part) for part in parts)) for name, parts in clouds(2, 3, 2)
    )
    episodes = alone(1, 2 + 6)
    for episode in episodes:
        episode.observations[:] += np.arange(8, dtype=np.float32)
    seen = stored(tmp_path, "seen-v0", episodes, ["task1"], observation_groups=clouds(2, 2, 0))
    data, first = join([seen], world, every=False), episodes[0].observations[0]
    assert data.observations[0].tolist() == [*first[:2], 0.0, *first[2:], 0.0, 1.0]
    # Of the same sizes altogether, but of other clouds, or of none.
    blind = stored(tmp_path, "blind-v0", alone(1, 2 + 6), ["task1"])
    few = stored(tmp_path, "few-v0", alone(1, 2 + 3), ["task1"], observation_groups=clouds(1, 2, 0))
    for dataset, told in ((blind, "none, the world: points of 2"), (few, "points of 1, the world: points of 2")):
        with pytest.raises(BidexError, match=f"has point clouds: {told}. Learn with the points"):
            join([dataset], world, every=False)


def test_padding_does_not_hide_that_touch_differs(tmp_path: Path) -> None:
    suite = replace(load_suite("MT4"), touch=True)
    worlds = [Benchmark(each).make_world(num_envs=4, device="cpu", threads=1) for each in (suite, "MT4")]
    for world, touch, told in ((worlds[0], False, "shows no touch"), (worlds[1], True, "shows touch")):
        seen = stored(tmp_path, f"{touch}-v0".lower(), alone(1, 422 + 14 * touch, 52), ["CatchUnderarm"], touch=touch)
        with pytest.raises(BidexError, match=f"{told} sensors, the world here"):
            join([seen], world, every=False)


def test_data_sets_imply_what_they_were_recorded_of():
    told = {"suite": None, "task": "CatchUnderarm", "base": "moving"}
    mug, egg = (SimpleNamespace(metadata=told | {"object": n, "points": p}) for n, p in (("mug", 64), (None, 0)))
    assert implied([mug, mug]) == {"task": "CatchUnderarm", "base": "moving", "object": "mug", "points": 64}
    assert implied([egg]) == {"task": "CatchUnderarm", "base": "moving"}
    assert implied([SimpleNamespace(metadata={})]) == {}

    def other(**more: Any) -> SimpleNamespace:
        return SimpleNamespace(metadata=egg.metadata | more)

    for differs, named in (
        (other(object="mug"), "of CatchUnderarm differ in object: its own and mug. Name the suite .* --suite NAME"),
        (other(points=64), "of CatchUnderarm differ in points: 0 and 64. Name some that were recorded alike"),
        (other(touch=True), "of CatchUnderarm differ in touch: False and True. Name some that were recorded alike"),
        (other(base="own"), "of CatchUnderarm differ in base: moving and own. .* --task NAME --base BASE"),
        (other(task="Switch"), "are of CatchUnderarm and Switch. Name the suite .* --suite NAME"),
    ):
        with pytest.raises(BidexError, match=named):
            implied([egg, differs])

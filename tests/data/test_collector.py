"""What is stored is what a plain loop saw."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bidex_meta.data import Episode, open_dataset
from bidex_meta.data.collector import BROKEN, CUT, SHORTENED, EpisodeCollector, RunCollector, spread_environments
from bidex_meta.data.writer import DatasetWriter, finish
from bidex_meta.errors import BidexError
from bidex_meta.world.contract import State
from tests.algos.families import Passing, PointClass, PointGoals
from tests.data.worlds import Plain, Rough, rough, same
from tests.world.play import suite_world

pytest.importorskip("h5py", reason="needs the extra data")


def complete(folder: Path, world: Rough) -> None:
    spaces = world.single_observation_space, world.single_action_space
    finish(folder, "Points/test-v0", *spaces, {"tasks": world.task_names, "kind": "test"})


def actions(seed: int, step: int, num: int) -> torch.Tensor:
    """Some beyond the bounds; now and then one that is no number."""
    drawn = 1.5 * torch.randn(num, 2, generator=torch.Generator().manual_seed(1000 * seed + step))
    if step % 11 == 7:
        drawn[step % num, 0] = torch.nan
    return drawn


@pytest.mark.parametrize("mode", ["SAME_STEP", "DISABLED"])
def test_an_episode_is_a_success_by_the_worlds_rule(mode: str) -> None:
    episodes: list[Episode] = []
    recorder = EpisodeCollector(Passing(8, mode), episodes.append)
    recorder.reset(seed=0)
    for _ in range(20):
        recorder.step(torch.zeros(8, 2))
    assert {each.row: each.success for each in episodes} == {row: row % 4 == 0 for row in range(8)}


@pytest.mark.parametrize("suite", ["MT1-Switch-v2", "ML1-Switch-v2"])
def test_an_episode_has_the_sentence_of_its_task(suite: str, tmp_path: Path) -> None:
    """Also in the file, as an attribute that Minari reads; where the suite hides its goal without the goal."""
    world = suite_world(suite, 3)
    writer = DatasetWriter(tmp_path)
    episodes: list[Episode] = []
    recorder = EpisodeCollector(world, lambda episode: (episodes.append(episode), writer.add(episode)))
    world.stagger = False
    recorder.reset(seed=0)
    played = world.instructions()
    for _ in range(int(world.max_episode_steps.max())):
        recorder.step(torch.zeros(3, world.action_size))
    assert [episode.instruction for episode in episodes] == played
    assert any(letter.isdigit() for letter in played[0]) == (suite[:2] == "MT")
    writer.commit()
    spaces = world.single_observation_space, world.single_action_space
    finish(tmp_path, "Switch/test-v0", *spaces, {"tasks": world.task_names, "kind": "test"})
    assert all(map(same, open_dataset(tmp_path).episodes(), episodes))


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 99),
    steps=st.integers(1, 30),
    mode=st.sampled_from(["SAME_STEP", "DISABLED"]),
    breaks_at=st.lists(st.tuples(st.integers(0, 30), st.integers(0, 4)), max_size=12),
    late=st.lists(st.integers(0, 4), max_size=5),
    resets=st.lists(st.tuples(st.integers(0, 30), st.lists(st.booleans(), min_size=5, max_size=5)), max_size=6),
    commits=st.sets(st.integers(0, 30), max_size=5),
)
def test_what_is_stored_is_what_a_plain_loop_saw(seed, steps, mode, breaks_at, late, resets, commits):
    """Over resets, time limits and broken rows; two processes write into one data set."""
    masks = dict(resets)
    with tempfile.TemporaryDirectory() as place:
        folder, seen, broken, worlds = Path(place) / "set", [], 0, []
        for process in range(2):
            make = lambda number=process: rough(mode=mode, breaks_at=tuple(breaks_at), late=tuple(late), seed=number)  # noqa: E731
            plain, writer = Plain(make()), DatasetWriter(folder, process)
            recorder = EpisodeCollector(make(), writer.add)
            plain.reset(seed=seed + process)
            recorder.reset(seed=seed + process)
            for step in range(steps):
                action = actions(seed, step, 5)
                plain.step(action)
                recorder.step(action.clone())
                if step in masks:
                    options = {"reset_mask": torch.tensor(masks[step])}
                    plain.reset(options=options)
                    recorder.reset(options=options)
                if step in commits:
                    writer.commit()
            writer.left_out.update(recorder.left_out)
            writer.commit()
            seen, broken = seen + plain.whole, broken + plain.broken
            worlds.append(recorder)
        complete(folder, worlds[0])
        dataset = open_dataset(folder)
        stored = list(dataset.episodes())
        assert len(stored) == len(seen) == dataset.num_episodes
        assert all(same(a, b) for a, b in zip(stored, seen, strict=True))
        assert dataset.metadata["left_out"].get(BROKEN, 0) == broken
        if stored:
            held = dataset.transitions()
            first = np.concatenate([episode.observations[:-1] for episode in seen])
            after = np.concatenate([episode.observations[1:] for episode in seen])
            assert np.array_equal(held["observations"], first) and np.array_equal(held["next_observations"], after)
            assert held["task"].tolist() == [e.task for e in seen for _ in range(len(e))]
            assert held["terminated"].tolist() == [bool(flag) for e in seen for flag in e.terminated]


def test_a_task_keeps_its_index_in_the_suites_pool_whatever_a_learner_plays() -> None:
    """RL² turns the pool from trial to trial, MAML puts a meta-batch in its place."""
    world = PointGoals(rows=2, classes=(PointClass(steps=4, count=6),))
    (pool,) = [pool.copy() for pool in world.pools]
    episodes: list[Episode] = []
    collector = EpisodeCollector(world, episodes.append)
    played = [np.roll(pool, -2, axis=0), pool[[4, 4]], pool[:2] + 0.25]
    for tasks in played:
        collector.set_tasks({world.task_names[0]: tasks})
        collector.reset()
        for _ in range(4):
            collector.step(torch.zeros(2, 2))
    assert [episode.task_index for episode in episodes] == [2, 3, 4, 4, -1, -1]
    assert np.array_equal(episodes[-1].variation, pool[1] + 0.25)


def test_nothing_is_committed_before_an_episode_ends(tmp_path: Path) -> None:
    world = rough(mode="SAME_STEP", late=(0, 0, 0, 0, 0))
    writer = DatasetWriter(tmp_path)
    recorder = EpisodeCollector(world, writer.add, rows=[0])
    recorder.reset(seed=0)
    writer.left_out.update(recorder.left_out)
    writer.commit()
    assert writer.parts == 0 and not list(writer.folder.iterdir())


def test_what_is_left_out_is_counted() -> None:
    world = rough(mode="SAME_STEP", breaks_at=((1, 0), (2, 3)), late=(0, 2, 0, 0, 0))
    found: list[Episode] = []
    recorder = EpisodeCollector(world, found.append, rows=[0, 1, 3])
    recorder.reset(seed=0)
    for _ in range(3):
        recorder.step(torch.zeros(5, 2))
    assert recorder.left_out == {BROKEN: 2, SHORTENED: 1, CUT: 0}
    assert [(episode.row, len(episode), episode.broken) for episode in found] == [(0, 1, True), (3, 2, True)]
    assert all(episode.truncated[-1] and not episode.terminated.any() for episode in found)
    recorder.reset()
    assert recorder.left_out[CUT] == 1  # the two others have just begun


def test_rows_are_spread_over_slots_and_checked() -> None:
    world = rough(num_envs=10)
    assert spread_environments(world, 0.4) == [0, 2, 5, 7] and spread_environments(world, 1e-9) == [0, 5]
    assert spread_environments(world, 7.0) == list(range(10))
    for rows in ([0, 0], [10], [-1]):
        with pytest.raises(BidexError, match="Expected different rows of 0 to 9"):
            EpisodeCollector(world, lambda episode: None, rows)


def test_a_run_that_goes_on_stores_each_episode_once(tmp_path: Path) -> None:
    """Saved after 12 steps, ended after 20, taken up at 12: as one that was never ended."""

    def drive(recorder: RunCollector, *steps: int) -> State:
        for step in range(*steps):
            recorder.step(actions(3, step, 5))
        return recorder.state_dict()

    whole, first, second = (RunCollector(rough(breaks_at=((9, 1),)), range(5)) for _ in range(3))
    for recorder, name in ((whole, "whole"), (first, "torn")):
        recorder.open(tmp_path / name)
        recorder.reset(seed=1)
    drive(whole, 30)
    state = drive(first, 12)
    drive(first, 12, 20)  # a part that the checkpoint above does not know
    second.folder = tmp_path / "torn"
    second.load_state_dict(state)
    drive(second, 12, 30)
    for name in ("whole", "torn"):
        complete(tmp_path / name, whole)
    a, b = (list(open_dataset(tmp_path / name).episodes()) for name in ("whole", "torn"))
    assert len(a) == len(b) > 10 and all(map(same, a, b))
    with pytest.raises(BidexError, match="saved without a recording"):
        second.load_state_dict(rough().state_dict())
    other = RunCollector(rough(), [0, 1])
    other.open(tmp_path / "other")
    with pytest.raises(BidexError, match="other environments"):
        other.load_state_dict(state)


def test_a_world_whose_later_episodes_would_be_missed_is_refused():
    with pytest.raises(BidexError, match="SAME_STEP or DISABLED to record, got NEXT_STEP"):
        EpisodeCollector(rough(mode="NEXT_STEP"), lambda episode: None)

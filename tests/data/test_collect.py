"""Rounds: as many as it takes, the same after a kill as without one, and readable by Minari."""

import os
import shutil
import signal
import traceback
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from bidex_meta.data import Dataset, collect, open_dataset, part_files, writer
from bidex_meta.data.collect import Actor, _plan, resumed_writer
from bidex_meta.data.collector import EpisodeCollector
from bidex_meta.errors import BidexError
from tests.data.worlds import rough, same

pytest.importorskip("h5py", reason="needs the extra data")

SIZE = 700
PLAN = {"kind": "test", "size": SIZE}


class Drifter:
    """Goes one way, and draws from a distribution around it."""

    def __init__(self, way: float) -> None:
        self.way = way

    def eval_action(self, obs: Tensor) -> Tensor:
        return torch.full((len(obs), 2), self.way)

    def sample_action(self, obs: Tensor, generator: torch.Generator) -> Tensor:
        return self.eval_action(obs) + 0.3 * torch.randn(len(obs), 2, generator=generator)

    def reset(self, env_mask: Tensor) -> None: ...


ACTORS = [Actor(Drifter(0.2), sampled=True), Actor(Drifter(-0.4), noise=0.1)]


def record(folder: Path, actors: list[Actor] = ACTORS, size: int = SIZE, brittle: bool = True) -> Dataset:
    """As the command does: goes on where it stopped."""
    world = rough(mode="DISABLED", brittle=brittle)
    writer.begin(folder, PLAN)
    out = resumed_writer(folder)
    collect.collect(world, actors, out, size, 5, lambda now, seconds: None)
    spaces = world.single_observation_space, world.single_action_space
    writer.finish(folder, "Points/test-v0", *spaces, {"tasks": world.task_names, "kind": "test"})
    return open_dataset(folder)


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collect, "PART_BYTES", 2500)


def test_sizes_and_shares(tmp_path: Path) -> None:
    found = record(tmp_path / "a")
    table = found.table
    steps = [int(table["steps"][table["policy"] == number].sum()) for number in range(2)]
    assert all(SIZE / 2 <= each < SIZE / 2 + 8 * 5 for each in steps)
    assert found.metadata["left_out"]["broken_transitions"] >= found.table["broken"].sum() > 5
    assert len(part_files.parts_of(found.folder)) > 5
    first, second = (np.concatenate([e.actions for e in found.episodes() if e.policy == n]) for n in range(2))
    assert abs(first.mean() - 0.2) < 0.05 and 0.2 < first.std() < 0.4
    assert abs(second.mean() + 0.4) < 0.02 and 0.05 < second.std() < 0.15
    alone = record(tmp_path / "b", [Actor(None)], 100)
    drawn = np.concatenate([episode.actions for episode in alone.episodes()])
    assert abs(drawn.mean()) < 0.15 and drawn.min() < -0.9 and drawn.max() > 0.9


def test_noise_is_added_apart_from_the_policys_own() -> None:
    """Drawn from one seed, both were the same normals."""
    world = rough(200, mode="DISABLED")
    obs, _ = world.reset(seed=0)
    drawn = Actor(Drifter(0.0), sampled=True).acting(world, 5)(obs).flatten()  # type: ignore[arg-type]
    both = Actor(Drifter(0.0), sampled=True, noise=0.1).acting(world, 5)(obs).flatten()  # type: ignore[arg-type]
    added = both - drawn
    assert 0.08 < added.std() < 0.12
    assert abs(np.corrcoef(drawn, added)[0, 1]) < 0.2


def test_every_row_plays_as_many_episodes(tmp_path: Path) -> None:
    """An episode that ends early is not played more often within a round."""
    found = record(tmp_path / "a", [Actor(None)], 100, brittle=False)
    rows = found.table["row"][: len(part_files.read_table(part_files.parts_of(found.folder)[0])["row"])]
    assert len(set(np.bincount(rows).tolist())) == 1


def _killed(work: Callable[[], object], at: int) -> bool:
    """Runs work in a process that kills itself at its ``at``-th moment; whether it was killed."""
    child = os.fork()
    if child == 0:
        count = [0]

        def counted(function: Any) -> Any:
            def call(*given: Any, **more: Any) -> Any:
                count[0] += 1
                if count[0] == at:
                    os.kill(os.getpid(), signal.SIGKILL)
                return function(*given, **more)

            return call

        os.fsync, os.replace = counted(os.fsync), counted(os.replace)
        EpisodeCollector.step = counted(EpisodeCollector.step)
        part_files.PartWriter.add = counted(part_files.PartWriter.add)
        try:
            work()
            os._exit(0)
        except BaseException:
            traceback.print_exc()
            os._exit(1)
    _, status = os.waitpid(child, 0)
    assert status in (0, signal.SIGKILL)
    return status == signal.SIGKILL


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_the_last_round_plays_each_task_once_before_any_task_twice() -> None:
    ids = [slice(0, 20), slice(20, 40)]  # environment j of a class plays task j modulo 10
    space = SimpleNamespace(shape=(4,))
    world: Any = SimpleNamespace(
        num_envs=40, slot_env_ids=ids, max_episode_steps=torch.full((40,), 10), single_observation_space=space,
        single_action_space=space,
    )  # fmt: skip
    now: Any = SimpleNamespace(episodes=[0], steps=[0])
    rows, repeats = _plan(world, 180, now, 0)
    chosen = np.flatnonzero(rows)
    assert repeats == 1 and len(chosen) == 19
    assert [len({row % 20 % 10 for row in chosen if row // 20 == of}) for of in (0, 1)] == [10, 9]


def test_killed_at_ten_moments_it_ends_with_the_same_data(tmp_path: Path) -> None:
    """Steps of the world, episodes on their way to the disk, before and after each renaming, and in the index."""
    expected = list(record(tmp_path / "whole").episodes())
    folder, kills = tmp_path / "torn", 0
    for at in (1, 2, 5, 9, 14, 20, 25, 30, 36, 41):
        kills += _killed(lambda: record(folder), at)
        temporary = [path for path in (folder / "data").glob(".part*")]
        assert len(temporary) <= 1
    assert kills == 10
    found = list(record(folder).episodes())
    assert len(found) == len(expected) and all(map(same, found, expected))
    assert not list((folder / "data").glob(".*")) and not (folder / "data" / part_files.RECORDING).exists()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_killed_while_the_index_is_written(tmp_path: Path) -> None:
    """At every moment between the last part and the end."""
    expected = record(tmp_path / "whole").num_episodes
    last, folder = 0, tmp_path / "torn"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "finish", lambda *given: None)
        with pytest.raises(BidexError, match="has not ended"):
            record(folder)
    for at in range(1, 20):
        copy = tmp_path / str(at)
        shutil.copytree(folder, copy)
        if not _killed(lambda place=copy: record(place), at):
            break
        last = at
        assert record(copy).num_episodes == expected
        assert not (copy / "data" / part_files.RECORDING).exists()
    assert last >= 4


def test_another_recording_or_a_complete_one_is_refused(tmp_path: Path) -> None:
    writer.begin(tmp_path / "a", PLAN)
    with pytest.raises(BidexError, match="with size 700, not 800"):
        writer.begin(tmp_path / "a", PLAN | {"size": 800})
    record(tmp_path / "a")
    with pytest.raises(BidexError, match="holds a complete data set"):
        writer.begin(tmp_path / "a", PLAN)
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "mine.txt").write_text("")
    with pytest.raises(BidexError, match="not empty"):
        writer.begin(tmp_path / "b", PLAN)


def test_nothing_to_record_is_said(tmp_path: Path) -> None:
    world = rough(mode="DISABLED", breaks_at=tuple((step, row) for step in range(60) for row in range(5)))
    with pytest.raises(BidexError, match="Physics broke in the first step of all 5"):
        collect.collect(world, [Actor(None)], writer.DatasetWriter(tmp_path), 100, 0, lambda now, seconds: None)


def test_minari_opens_and_samples_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minari = pytest.importorskip("minari", reason="needs the extra data")
    ours = record(tmp_path / "Points" / "test-v0")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    theirs = minari.load_dataset("Points/test-v0")
    assert (theirs.total_episodes, theirs.total_steps) == (ours.num_episodes, ours.num_steps)
    told = theirs.storage.get_episode_metadata(range(ours.num_episodes))
    for mine, its, words in zip(ours.episodes(), theirs.iterate_episodes(), told, strict=True):
        assert np.array_equal(mine.observations, its.observations) and np.array_equal(mine.actions, its.actions)
        assert np.array_equal(mine.terminated, its.terminations) and np.array_equal(mine.truncated, its.truncations)
        assert mine.rewards.sum() == its.rewards.sum() and words["task_name"] == mine.task_name
        assert np.array_equal(words["variation"], mine.variation) and words["success"] == mine.success
    assert len(theirs.sample_episodes(4)) == 4 and "ndarray" in repr(theirs[0])
    assert theirs.spec.action_space.shape == (2,)
    assert list(minari.list_local_datasets()) == ["Points/test-v0"]
    # The other direction: we read what Minari wrote.
    spaces = {name: getattr(theirs.spec, name) for name in ("observation_space", "action_space")}
    buffer: Any = import_module("minari.data_collector.episode_buffer").EpisodeBuffer
    columns = [{name: getattr(e, own) for name, own in part_files.ARRAYS.items()} for e in ours.episodes()]
    its = minari.create_dataset_from_buffers("other/mine-v0", [buffer(**each, infos={}) for each in columns], **spaces)
    again = open_dataset(tmp_path / "other" / "mine-v0")
    assert again.num_steps == its.total_steps and again.metadata["kind"] == "outside"
    assert all(torch.equal(again.transitions()[n], t) for n, t in ours.transitions().items() if n != "task")

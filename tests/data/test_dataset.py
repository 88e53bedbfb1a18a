"""Damaged data sets: every flipped bit is found, and whatever else is wrong is one line; disks that are full."""

import json
import os
import random
import resource
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

from bidex_meta.data import Dataset, open_dataset, part_files
from bidex_meta.data.checking import coverage, summary, verify
from bidex_meta.data.joined import gathered, join
from bidex_meta.data.writer import begin, stored_plan
from bidex_meta.errors import BidexError
from bidex_meta.experiments.run_data import implied
from tests.algos.problems import one_step_bandit
from tests.data.test_collect import record
from tests.data.worlds import ABOUT, changed, rough, same, small_set, without_digests
from tests.robust.damage import NO_FILES, ODD, of_values, remove, replace
from tests.robust.kills import quick_folder
from tests.robust.lines import called
from tests.robust.test_damaged_files import draws, one_line_or

h5py = pytest.importorskip("h5py", reason="needs the extra data")
pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs pipes, links and limits")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """``data`` of a small data set."""
    return small_set(tmp_path / "small-v0").folder


def unlike(dataset: Dataset, whole: dict[str, torch.Tensor]) -> bool:
    found = dataset.transitions()
    return any(not torch.equal(found[name], whole[name]) for name in whole)


def test_every_flipped_bit_is_found(folder: Path) -> None:
    """By a check, wherever it is; and no other number is ever learned from."""
    whole, draw = open_dataset(folder).transitions(), random.Random(0)
    assert verify(open_dataset(folder)).unsealed == []
    for path in sorted(folder.iterdir()):
        data = path.read_bytes()
        # These are all of the first bytes, which hold the digest and HDF5's own header, and some of the others.
        places = [*range(0, 80, 5), 300, 511, 512, len(data) - 1, *(draw.randrange(len(data)) for _ in range(40))]
        for place in (*places, *range(len(data) - 40, len(data), 3)):
            path.write_bytes(data[:place] + bytes([data[place] ^ (1 << draw.randrange(8))]) + data[place + 1 :])
            with pytest.raises(BidexError, match="is damaged: expected the length and digest"):
                verify(open_dataset(folder))
            if path.name != part_files.MAIN:  # of ours that is Minari's alone
                with pytest.raises(BidexError, match="is damaged"):
                    unlike(open_dataset(folder), whole)
        path.write_bytes(data)
    assert not unlike(open_dataset(folder), whole) and learned(open_dataset(folder)) == 33


def test_a_part_is_held_to_its_digest_before_its_episodes_are_read(folder, monkeypatch):
    """Of a set too large to be read at once when it is opened."""
    monkeypatch.setattr("bidex_meta.data.dataset._CHECKED_AT_OPENING", 8000)
    path = part_files.parts_of(folder)[-1]
    with h5py.File(path, "r+") as file:
        file["episode_2"]["actions"][0, 0] += 0.25
    dataset = open_dataset(folder)
    assert len(dataset.table["steps"]) == 6
    episodes = dataset.episodes()
    assert [len(next(episodes)) for _ in range(3)] == [3, 4, 5]
    with pytest.raises(BidexError, match="is damaged: expected the length and digest"):
        next(episodes)


def test_sets_without_digests_load_as_before(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = open_dataset(folder).transitions()
    without_digests(folder)
    assert not unlike(open_dataset(folder), whole)
    done = called(["data", "check", str(folder.parent)])
    assert done.code == 0 and "Files without a digest, from elsewhere: 4." in done.out
    make_foreign(folder)
    assert len(verify(open_dataset(folder)).unsealed) == 2


def make_foreign(folder: Path, **more: object) -> None:
    """Makes of a data set what Minari would have written: one file, none of our entries."""
    episodes = list(open_dataset(folder).episodes())
    for path in part_files.parts_of(folder):
        path.unlink()
    with h5py.File(folder / part_files.MAIN, "w") as file:
        for number, episode in enumerate(episodes):
            for name, ours in part_files.ARRAYS.items():
                file[f"episode_{number}/{name}"] = getattr(episode, ours)
    content = json.loads((folder / part_files.METADATA).read_text())
    content = {name: value for name, value in content.items() if name not in ("bidex", "digest")}
    (folder / part_files.METADATA).write_text(json.dumps(content | more))


def instead(name: str, value: object) -> Callable[[Any], None]:
    """Puts something else in the place of an object."""

    def put(file: Any) -> None:
        del file[name]
        if value is not None:
            file[name] = value

    return put


def cut(name: str, of: int | None = -1) -> Callable[[Any], None]:
    return lambda file: instead(name, file[name][:of])(file)


EPISODES = {
    "episode a number": instead("episode_1", 3),
    "episode an array": instead("episode_1", np.zeros(4)),
    "episode gone": instead("episode_1", None),
    "episode a type": instead("episode_1", np.dtype("f4")),
    "episode links to itself": instead("episode_1", h5py.SoftLink("/episode_1")),
    "episode links to nothing": instead("episode_1", h5py.SoftLink("/none")),
    "episode links to another file": instead("episode_1", h5py.ExternalLink("none.hdf5", "/episode_1")),
    "episode a loop over files": instead("episode_1", h5py.ExternalLink("main_data.hdf5", "/episode_1")),
    "array links to its group": instead("episode_1/actions", h5py.SoftLink("/episode_1")),
    **{f"{name} cut": cut(f"episode_1/{name}") for name in part_files.ARRAYS},
    **{f"{name} empty": cut(f"episode_1/{name}", 0) for name in part_files.ARRAYS},
    **{f"{name} a number": instead(f"episode_1/{name}", 1.0) for name in part_files.ARRAYS},
    **{f"{name} of three dimensions": instead(f"episode_1/{name}", np.ones((4, 2, 2))) for name in part_files.ARRAYS},
    **{f"{name} texts": instead(f"episode_1/{name}", [b"a"] * 4) for name in part_files.ARRAYS},
    **{f"{name} nothing": instead(f"episode_1/{name}", h5py.Empty("f4")) for name in part_files.ARRAYS},
    "observations narrow": instead("episode_1/observations", np.zeros((5, 4), np.float32)),
    "actions wide": instead("episode_1/actions", np.zeros((4, 3), np.float32)),
    "rewards too many": instead("episode_1/rewards", np.zeros(9, np.float32)),
}
"""What may be wrong with an episode, ours and others'."""
TABLES = {
    "table a number": instead("table", 1),
    "table gone": instead("table", None),
    "column gone": instead("table/task", None),
    "column cut": cut("table/task"),
    "column a group": lambda file: instead("table/success", None)(file) or file.create_group("table/success"),
    "steps a number": instead("table/steps", 3),
    "steps of floats": instead("table/steps", np.ones(3)),
    "steps negative": instead("table/steps", np.array([-3, 4, 11])),
    "steps huge": instead("table/steps", np.array([2**62, 2**62, 2**62])),
    "steps moved": instead("table/steps", np.array([4, 3, 5])),
    "task unknown": instead("table/task", np.array([0, 1, 2])),
    "task negative": instead("table/task", np.array([0, -1, 0])),
    "variation flat": instead("table/variation", np.zeros(3)),
    "returns texts": instead("table/return", [b"x"] * 3),
}
"""What may be wrong with a part's table."""


def learned(dataset: Dataset) -> int:
    """How many transitions a learner would get."""
    if "bidex" in dataset.content:
        return len(join([dataset], rough(4)))
    world: Any = one_step_bandit(rows=2)
    world.single_observation_space = Box(-np.inf, np.inf, (5 + world.num_id_columns,), np.float32)
    return len(join([dataset], world))


def is_refused(folder: Path) -> None:
    """One line, whoever asks."""
    for words in (["info"], ["check"]):
        done = called(["data", *words, str(folder.parent)])
        assert done.code == 2 and len(done.err.strip().splitlines()) == 1, done
    for read in (Dataset.transitions, learned, lambda dataset: list(dataset.episodes())):
        assert one_line_or(lambda read=read: read(open_dataset(folder))) is None


@pytest.mark.parametrize("damage", [*EPISODES, *TABLES])
def test_a_damaged_part_is_one_line(damage: str, folder: Path) -> None:
    with changed(part_files.parts_of(folder)[0]) as file:
        {**EPISODES, **TABLES}[damage](file)
    is_refused(folder)


@pytest.mark.parametrize("damage", EPISODES)
def test_a_damaged_file_from_elsewhere_is_one_line(damage: str, folder: Path) -> None:
    make_foreign(folder)
    assert learned(open_dataset(folder)) == 33
    with h5py.File(folder / part_files.MAIN, "r+") as file:
        EPISODES[damage](file)
    is_refused(folder)


@pytest.mark.parametrize("told", [{"total_steps": n} for n in (0, 32, 34, 10**15)] + [{"total_episodes": 10**12}])
def test_totals_from_elsewhere_are_not_believed(told: dict[str, int], folder: Path) -> None:
    make_foreign(folder, **told)
    is_refused(folder)


def test_nothing_unwritten_is_read(folder: Path) -> None:
    """What is asked for and not filled would be rows of whatever stood in memory."""
    episodes = [(episode, 0, episode.observations) for episode in open_dataset(folder).episodes()]
    with pytest.raises(BidexError, match="Expected 40 transitions, got 33"):
        gathered(episodes, 40, 6, 5, 2)


@pytest.mark.parametrize("ours", [True, False])
def test_damaged_metadata_is_one_line_or_read(ours: bool, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if ours:
        without_digests(folder)
    else:
        make_foreign(folder)
    monkeypatch.setenv("BIDEX_DATA", str(folder.parents[1]))
    path = folder / part_files.METADATA
    data = path.read_bytes()
    values = [b"NaN", b"Infinity", b"-1e400"]

    def check(drawn: Any) -> None:
        remove(path)
        if drawn in NO_FILES:
            replace(path, drawn)
        else:
            path.write_bytes(drawn[1](data))
        for words in (["list"], ["info", "small-v0"], ["check", "small-v0"]):
            done = called(["data", *words])
            assert done.code in (0, 1, 2) and (done.code != 2 or len(done.err.strip().splitlines()) == 1), done
        one_line_or(lambda: learned(open_dataset(folder)))

    try:
        for value in values:
            for entry in (b"33", b"6", b"0.5", b"1.0", b"4"):
                check(("number", lambda data, value=value, entry=entry: data.replace(b" " + entry, b" " + value)))
        draws(40, of_values(), check)
        for name in NO_FILES:
            check(name)
    finally:
        remove(path)


@pytest.mark.parametrize("entry", ABOUT)
def test_an_odd_entry_of_the_metadata_is_one_line_or_read(entry: str, folder: Path) -> None:
    """By all that reads it."""
    without_digests(folder)
    content = json.loads((folder / part_files.METADATA).read_text())

    def look() -> None:
        dataset = open_dataset(folder)
        summary(dataset), coverage(dataset), verify(dataset), implied([dataset]), learned(dataset)

    for value in ODD:
        content["bidex"][entry] = value
        (folder / part_files.METADATA).write_text(json.dumps(content))
        one_line_or(look)


@pytest.mark.parametrize("kind", NO_FILES)
@pytest.mark.parametrize("which", ["part-0-00001.hdf5", "main_data.hdf5"])
def test_what_is_no_file_is_one_line(kind: str, which: str, folder: Path) -> None:
    replace(folder / which, kind)
    with pytest.raises(BidexError):
        verify(open_dataset(folder))


def test_loops_of_links_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BIDEX_DATA", str(tmp_path))
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    (tmp_path / "c" / "data").mkdir(parents=True)
    (tmp_path / "c" / "data" / "metadata.json").symlink_to("metadata.json")
    few = ["--task", "CatchUnderarm", "--size", "10", "--num-envs", "2"]
    for words in (["data", "info"], ["data", "check"], ["record", "random", *few, "--out"]):
        for name in ("a", "c") if words[0] == "data" else ("a", "a/x"):
            done = called([*words, str(tmp_path / name)])
            assert done.code == 2 and len(done.err.strip().splitlines()) == 1, done
    assert called(["data", "list"]).code == 0


@pytest.mark.parametrize("plan", [[], 3, {"threads": "x"}, {"threads": -1}, {"size": 10**18}, {"kind": "x" * 5000}])
def test_an_odd_plan_of_a_recording_is_one_line(plan: object, tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / part_files.RECORDING).write_text(json.dumps(plan))
    for read in (lambda: begin(tmp_path, {"kind": "test"}), lambda: begin(tmp_path, {}) and stored_plan(tmp_path)):
        assert one_line_or(read) is None


@pytest.fixture
def limit(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int | None], None]]:
    """Sets the bytes that a file may have, as a full disk would; what is printed of errors nobody catches fails."""
    unraisable: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", unraisable.append)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (before[0] if size is None else size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert unraisable == []


def test_a_disk_that_fills_while_it_is_recorded_loses_no_part(limit, monkeypatch):
    """At whatever byte it ends; with room again the same command goes on to the same data."""
    monkeypatch.setattr("bidex_meta.data.collect.PART_BYTES", 20_000)
    with quick_folder() as place:
        expected = list(record(place / "whole", size=200).episodes())
        most = max(path.stat().st_size for path in (place / "whole" / "data").iterdir())
        for number, size in enumerate((0, 511, 9000, most - 1)):
            folder = place / str(number)
            limit(size)
            try:
                with pytest.raises((OSError, BidexError), match="File too large"):
                    record(folder, size=200)
            finally:
                limit(None)
            assert not list((folder / "data").glob(".part-*"))
            found = list(record(folder, size=200).episodes())
            assert len(found) == len(expected) and all(map(same, found, expected))
            verify(open_dataset(folder))

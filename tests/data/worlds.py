"""A world that does all that a recorder must bear, and a plain loop that says what it did."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from torch import Tensor

from bidex_meta.cli import main
from bidex_meta.data import Dataset, Episode, open_dataset, part_files, seals
from bidex_meta.data.writer import DatasetWriter, finish
from tests.fake_world import FakeWorld
from tests.points import PointWorld, ring


def printed(capsys: pytest.CaptureFixture[str], *words: object, code: int = 0) -> str:
    """What a command line prints; it must end with this exit code."""
    capsys.readouterr()
    try:
        assert main([str(word) for word in words]) == code
    except SystemExit as end:
        assert end.code == code
    out = capsys.readouterr()
    return out.out + out.err


class Rough(PointWorld):
    """Points whose episodes end early or by time, break at (step, row) pairs, and may begin within.

    ``brittle``: about one step in 23 breaks, by seed, row, episode and step alone; ``late``: elapsed step at which the
    first episode of each row begins in SAME_STEP mode.
    """

    def __init__(
        self,
        *given: Any,
        breaks_at: tuple[tuple[int, int], ...] = (),
        brittle: bool = False,
        late: tuple[int, ...] = (),
        **more: Any,
    ):
        super().__init__(*given, **more)
        self.unstable, self._brittle, self._late = breaks_at, brittle, late

    def _broken(self) -> Tensor:
        drawn = self.seed % 97 + 7 * torch.arange(self.num_envs) + 3 * self.episodes.number + 5 * self.episodes.elapsed
        return FakeWorld._broken(self) | (self._brittle & (drawn % 23 == 0))

    def _first_elapsed(self) -> Tensor:
        return torch.tensor([*self._late, *[0] * self.num_envs][: self.num_envs])


def rough(num_envs: int = 5, mode: str = "SAME_STEP", **more: Any) -> Rough:
    """Two slots, of three and two tasks."""
    return Rough(num_envs, {"Near": 0.5 * ring(3), "Far": ring(2)}, (5, 8), ends=True, noise=0.4, mode=mode, **more)


@dataclass
class Plain:
    """What a plain loop sees of a world: each row's running episode as lists, and those that were whole."""

    world: Rough
    whole: list[Episode] = field(default_factory=list)
    broken: int = 0

    def __post_init__(self) -> None:
        self.running: list[dict[str, Any] | None] = [None] * self.world.num_envs

    def reset(self, **keywords: Any) -> Tensor:
        obs, _ = self.world.reset(**keywords)
        mask = (keywords.get("options") or {}).get("reset_mask", torch.ones(self.world.num_envs, dtype=torch.bool))
        for row in mask.nonzero().squeeze(1).tolist():
            self._start(row, obs)
        return obs

    def step(self, action: Tensor) -> Tensor:
        obs, reward, terminated, truncated, info = self.world.step(action)
        for row, now in enumerate(self.running):
            if now is None:
                continue
            if info["unstable"][row]:
                self.broken += 1
            else:
                now["observations"].append(info["final_obs"][row].numpy().copy())
                now["actions"].append(action[row].clamp(-1, 1).numpy().copy())
                now["rewards"].append(float(reward[row]))
                now["unscaled"].append(float(info["reward_unscaled"][row]))
            now["success"] = bool(info["running"]["success"][row])
            if terminated[row] or truncated[row]:
                if info["episode_mask"][row] and now["rewards"]:
                    self.whole.append(self._episode(row, now, bool(terminated[row]), bool(info["unstable"][row])))
                self.running[row] = None
                if self.world.metadata["autoreset_mode"].name == "SAME_STEP":
                    self._start(row, obs)
        return obs

    def _start(self, row: int, obs: Tensor) -> None:
        first = {"observations": [obs[row].numpy().copy()], "task": int(self.world.task_index[row])}
        self.running[row] = {**first, "actions": [], "rewards": [], "unscaled": [], "success": False}

    def _episode(self, row: int, now: dict[str, Any], terminated: bool, unstable: bool) -> Episode:
        slot, last = int(self.world.task_id[row]), [False] * (len(now["rewards"]) - 1)
        return Episode(
            np.stack(now["observations"]),
            np.stack(now["actions"]),
            np.array(now["rewards"], np.float32),
            np.array([*last, terminated]),
            np.array([*last, not terminated]),
            task=slot,
            task_name=self.world.task_names[slot],
            task_index=now["task"],
            variation=self.world.pools[slot][now["task"]],
            success=now["success"],
            broken=unstable,
            return_unscaled=float(np.sum(now["unscaled"])),
            row=row,
        )


def same(a: Episode, b: Episode) -> bool:
    """Whether two episodes are equal, arrays bit for bit."""
    arrays = ("observations", "actions", "rewards", "terminated", "truncated", "variation")
    words = ("task", "task_name", "task_index", "success", "broken", "row", "policy", "instruction")
    return (
        all(np.array_equal(getattr(a, name), getattr(b, name)) for name in arrays)
        and all(getattr(a, name) == getattr(b, name) for name in words)
        and abs(a.return_unscaled - b.return_unscaled) < 1e-4
    )


ABOUT = {
    "suite": "MT4", "suite_version": 1, "task": None, "object": None, "points": 0, "base": None, "seed": 0,
    "tasks": ["Near", "Far"], "kind": "random", "reward_scales": {"Near": 1.0, "Far": 0.5}, "hides_goals": False,
    "observation_groups": [["state", [[0, 3]]], ["task_id", [[3, 5]]]],
    "policies": [{"algo": None, "actions": "uniform"}], "commit": "abc", "versions": {"mujoco": "4.0.0"},
    "physics": {},
    "references": {"Near": {"random": 0.0, "zero": None, "expert": 9.0}, "Far": {"random": 1.0}},
}  # fmt: skip
"""Metadata as a recording has them."""


def small_set(folder: Path) -> Dataset:
    """Two parts of three episodes each, of 3 to 8 steps, 5 observations and 2 actions."""
    draw, writer = np.random.default_rng(0), DatasetWriter(folder)
    for number in range(6):
        steps, last = 3 + number, np.arange(3 + number) == 2 + number
        arrays = [draw.uniform(-1, 1, (n, k)).astype(np.float32) for n, k in ((steps + 1, 5), (steps, 2), (steps, 1))]
        scaled = float(arrays[2].sum(dtype=np.float64)) / (1.0, 0.5)[number % 2]
        more = {"task": number % 2, "task_name": ABOUT["tasks"][number % 2], "return_unscaled": scaled}
        writer.add(Episode(*arrays[:2], arrays[2][:, 0], last, ~last & last, variation=np.ones(2), **more))
        if number % 3 == 2:
            writer.commit()
    finish(folder, "Points/small-v0", Box(-1.0, 1.0, (5,)), Box(-1.0, 1.0, (2,)), ABOUT)
    return open_dataset(folder)


@contextmanager
def changed(path: Path) -> Iterator[Any]:
    """h5py's file of a part, to be changed on purpose; then it gets a digest again."""
    with part_files.hdf5().File(path, "r+") as file:
        yield file
    with path.open("r+b") as file:
        block = seals.block(file)
        file.seek(0)
        file.write(block)


def without_digests(folder: Path) -> None:
    """Makes of a data set's files in a folder what they were before there were digests."""
    h5 = part_files.hdf5()
    for path in folder.glob("*.hdf5"):
        with h5.File(path, "r") as new, h5.File(folder / "old", "w") as old:
            for name in new:
                if path.name == part_files.MAIN:
                    old[name] = new.get(name, getlink=True)
                else:
                    new.copy(name, old)
            old.attrs.update(new.attrs)
        (folder / "old").replace(path)
    path = folder / part_files.METADATA
    content = json.loads(path.read_text())
    del content["digest"], content["bidex"]["sealed"]
    path.write_text(json.dumps(content))

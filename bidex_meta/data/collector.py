"""Wrappers around a world that collect whole episodes of chosen environments exactly as they were played."""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bidex_meta.data import part_files
from bidex_meta.data.part_files import Episode
from bidex_meta.data.writer import DatasetWriter
from bidex_meta.errors import BidexError
from bidex_meta.runs.atomic import write_json
from bidex_meta.world.checked import clean
from bidex_meta.world.contract import Info, Options, PooledWorld, State, Step, TaskWorld, VectorWorld
from bidex_meta.world.wrapper import PooledWorldWrapper

# Initial buffer, in steps of an episode, in a world without time limit; it doubles when an episode is longer.
_FIRST_ROOM = 64
BROKEN, SHORTENED, CUT = "broken_transitions", "shortened_episodes", "cut_episodes"
"""Reasons for leaving data out: physics broke in a transition; an episode began after its first step, as can happen in
a training world; a reset cut an episode."""
_KEY = "recorder"  # name of our entry in a checkpoint's world state


class EpisodeCollector(PooledWorldWrapper):
    """Collects whole episodes without changing what the world does.

    ``rows`` are the environments to collect from (None: all). ``sink`` receives each episode when the episode has
    ended; episodes that end in the same step arrive by ascending environment. If physics breaks in a transition, the
    episode is stored without this transition and is marked as truncated. ``left_out`` counts uncollected transitions
    and episodes by reason. ``policy`` is the number of the acting policy, which is stored with each episode.
    ``active``, bool (rows,), marks the environments whose new episodes are collected (at first all of them).

    Memory holds only the running episodes of ``rows``: 4 (d + a + 2) bytes for each step of one environment.
    """

    def __init__(self, world: VectorWorld, sink: Callable[[Episode], None], rows: Sequence[int] | None = None) -> None:
        super().__init__(world)  # type: ignore[arg-type]  # without pools there are no variations
        if world.metadata["autoreset_mode"].name == "NEXT_STEP":
            fault = "Expected a world in autoreset mode SAME_STEP or DISABLED to record, got NEXT_STEP"
            raise BidexError(f"{fault}; make it without autoreset_mode.")
        if rows is None:
            chosen = range(world.num_envs)
        else:
            chosen = rows
        if len(set(chosen)) != len(chosen) or not all(0 <= row < world.num_envs for row in chosen):
            most = world.num_envs - 1
            raise BidexError(f"Expected different rows of 0 to {most} to record, got {list(chosen)[:10]}.")
        self.rows = list(chosen)
        self.policy = 0
        self._sink = sink
        self.left_out: Counter[str] = Counter()
        self.active = np.ones(len(self.rows), bool)
        self._where = torch.tensor(self.rows, dtype=torch.int64, device=world.device)
        self._slots = world.task_id[self._where].tolist()
        self._pools: list[np.ndarray] = []
        self._first_pools: list[np.ndarray] = []
        if isinstance(world, PooledWorld):
            self._first_pools = [pool.copy() for pool in world.pools]
        self._forget()

    def _forget(self) -> None:
        """Drop all running episodes."""
        num = len(self.rows)
        room = _FIRST_ROOM
        if isinstance(self.world, TaskWorld) and num:
            # The operating system allocates no memory for pages that no episode reaches.
            room = int(self.world.max_episode_steps[self._where].max())
        d, a = (int(s.shape[0]) for s in (self.world.single_observation_space, self.world.single_action_space))
        self._observations = np.zeros((num, room + 1, d), np.float32)
        self._actions = np.zeros((num, room, a), np.float32)
        self._rewards = np.zeros((2, num, room), np.float32)  # scaled rewards, and unscaled ones
        self._running = np.zeros(num, bool)
        self._length = np.zeros(num, np.int64)
        self._task = np.zeros(num, np.int64)

    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[Tensor, Info]:
        """Start episodes; discard the running episodes of the environments that are reset."""
        obs, info = self.world.reset(seed=seed, options=options)
        mask = (options or {}).get("reset_mask")
        if mask is None:
            begun = np.ones(len(self.rows), bool)
        else:
            begun = self._own(torch.as_tensor(mask))
        if begun.all() or not self._pools:
            self._read_pools()  # a reset of all environments may bring other tasks
        self.left_out[CUT] += int((begun & self._running & (self._length > 0)).sum())
        self._begin(begun, self._own(obs))
        return obs, info

    def step(self, action: Tensor, /) -> Step:
        """Take actions (N, a); see ``VectorWorld``."""
        taken = self._own(clean(torch.as_tensor(action, dtype=torch.float32))[0])
        result = obs, reward, terminated, _, info = self.world.step(action)
        if not self._running.any():
            self._begin_again(info, obs)
            return result
        unstable, ended, episode_mask = (self._own(info[name]) for name in ("unstable", "_final_obs", "episode_mask"))
        good = np.flatnonzero(self._running & ~unstable)
        self._make_room(int(self._length.max()) + 1)
        at = self._length[good]
        self._actions[good, at] = taken[good]
        self._rewards[0, good, at] = self._own(reward)[good]
        self._rewards[1, good, at] = self._own(info["reward_unscaled"])[good]
        self._observations[good, at + 1] = self._own(info["final_obs"])[good]
        self._length[good] += 1
        self.left_out[BROKEN] += int((self._running & unstable).sum())
        over = np.flatnonzero(self._running & ended)
        if len(over):
            true_end = self._own(terminated)
            success = self._own(info["running"]["success"])
            for row in over.tolist():
                self._end(row, bool(true_end[row]), bool(unstable[row]), bool(episode_mask[row]), bool(success[row]))
            self._running[over] = False
        self._begin_again(info, obs)
        return result

    def _own(self, of_all: Tensor) -> np.ndarray:
        return of_all.to(self._where.device)[self._where].detach().cpu().numpy()

    def _begin_again(self, info: dict[str, Tensor], obs: Tensor) -> None:
        """Begin the episodes that a world in SAME_STEP mode has started within the step."""
        if self.world.metadata["autoreset_mode"].name == "SAME_STEP":
            begun = self._own(info["_final_obs"])
            if begun.any():
                self._begin(begun, self._own(obs))

    def _begin(self, mask: np.ndarray, obs: np.ndarray) -> None:
        if getattr(self.world, "endless", False):
            self._read_pools()  # each episode may have a new task
        self._running &= ~mask
        mask = mask & self.active
        self._observations[mask, 0] = obs[mask]
        self._length[mask] = 0
        self._running |= mask
        if isinstance(self.world, TaskWorld):
            self._task = np.where(mask, self._own(self.world.task_index), self._task)

    def _end(self, row: int, terminated: bool, unstable: bool, episode_mask: bool, success: bool) -> None:
        """Pass an ended episode to the sink.

        An episode is discarded if it began after its first step (``episode_mask`` is False), or if physics broke in its
        first transition.
        """
        length = int(self._length[row])
        slot = self._slots[row]
        task = int(self._task[row])
        if not episode_mask:
            self.left_out[SHORTENED] += 1
        if not episode_mask or length == 0:
            return
        last = np.arange(length) == length - 1
        rewards, unscaled = self._rewards[:, row, :length]
        variation = np.zeros(0)
        instruction = ""
        if self._pools:
            variation = self._pools[slot][task].copy()
            task = _index_in(self._first_pools[slot], variation, task)
        describe = getattr(self.world, "instruction", None)
        if describe is not None:  # worlds of other libraries have no sentences
            instruction = describe(slot, variation)
        self._sink(
            Episode(
                observations=self._observations[row, : length + 1].copy(),
                actions=self._actions[row, :length].copy(),
                rewards=rewards.copy(),
                terminated=last & terminated,
                truncated=last & (not terminated),
                task=slot,
                task_name=self.world.task_names[slot],
                task_index=task,
                variation=variation,
                success=success,
                broken=unstable,
                return_unscaled=float(unscaled.sum(dtype=np.float64)),
                row=self.rows[row],
                policy=self.policy,
                instruction=instruction,
            )
        )

    def _make_room(self, steps: int) -> None:
        room = self._actions.shape[1]
        if steps <= room:
            return
        padding = [(0, 0), (0, room), (0, 0)]
        self._observations = np.pad(self._observations, padding)
        self._actions = np.pad(self._actions, padding)
        self._rewards = np.pad(self._rewards, [(0, 0), (0, 0), (0, room)])

    def load_state_dict(self, state: State) -> None:
        """Restore the world's state; do not collect its running episodes, because their beginning is unknown."""
        self.world.load_state_dict(state)
        self._forget()

    def collector_state(self) -> dict[str, Tensor]:
        """Return the running episodes as copied tensors, for a checkpoint."""
        most = int(self._length.max(initial=0))
        arrays = {"observations": self._observations[:, : most + 1], "actions": self._actions[:, :most]}
        arrays |= {"rewards": self._rewards[:, :, :most], "running": self._running}
        arrays |= {"length": self._length, "task": self._task, "rows": np.array(self.rows, np.int64)}
        return {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}

    def load_collector_state(self, state: dict[str, Tensor]) -> None:
        """Continue from ``collector_state`` in a restored world; raise BidexError if environments or sizes differ."""
        given = {name: value.numpy() for name, value in state.items()}
        self._forget()
        sizes = [given[name].shape[-1] for name in ("observations", "actions")]
        if given["rows"].tolist() != self.rows or sizes != [self._observations.shape[-1], self._actions.shape[-1]]:
            raise BidexError(
                "The recorded episodes in this checkpoint have other environments or sizes. Start a new run."
            )
        most = given["actions"].shape[1]
        while self._actions.shape[1] < most:
            self._make_room(self._actions.shape[1] + 1)
        self._observations[:, : most + 1] = given["observations"]
        self._actions[:, :most] = given["actions"]
        self._rewards[:, :, :most] = given["rewards"]
        self._running = given["running"].copy()
        self._length = given["length"].copy()
        self._task = given["task"].copy()
        self._read_pools()

    def _read_pools(self) -> None:
        if isinstance(self.world, PooledWorld):
            self._pools = list(self.world.pools)
        else:
            self._pools = []


def _index_in(pool: np.ndarray, variation: np.ndarray, index: int) -> int:
    """Return the index of a task in a pool (k, v): ``index`` if this task is there, and -1 if the pool lacks it.

    Learners may play their tasks in other pools, for example in another order.
    """
    same = np.flatnonzero((pool == variation).all(axis=1))
    if index in same:
        return index
    return int(same[0]) if len(same) else -1


class RunCollector(EpisodeCollector):
    """Collects episodes in the environments ``rows`` of a run's training world; a resumed run stores no episode twice.

    Saving a checkpoint calls ``state_dict``, which writes the collected episodes as a part of the data set. The
    returned state holds the number of parts and the running episodes. A run that resumes from this state deletes later
    parts and plays their episodes again. ``folder`` is the data set's folder. Call ``open``, or set ``folder`` before
    ``load_state_dict``, which opens the folder.
    """

    folder: Path

    def __init__(self, world: VectorWorld, rows: Sequence[int], process: int = 0) -> None:
        self.process = process
        self._writer = None
        super().__init__(world, lambda episode: self.writer.add(episode), rows)

    @property
    def writer(self) -> DatasetWriter:
        """Return the writer of the open folder."""
        assert self._writer is not None, "open the folder first"
        return self._writer

    def open(self, folder: Path, parts: int = 0) -> None:
        """Open the data set ``folder`` for recording; this is done before the first reset.

        Parts of this process with number ``parts`` or higher are deleted.
        """
        self.folder = folder
        self._writer = DatasetWriter(folder, self.process, keep=parts)
        if self.process == 0:  # the data set is no longer complete
            write_json(folder / "data" / part_files.RECORDING, {"run": folder.parent.name})
            (folder / "data" / part_files.METADATA).unlink(missing_ok=True)

    def state_dict(self) -> State:
        """Return the world's state, the number of parts, and the running episodes."""
        self.writer.left_out.update(self.left_out)
        self.left_out.clear()
        self.writer.commit()
        return {**self.world.state_dict(), _KEY: {"parts": self.writer.parts, **self.collector_state()}}

    def load_state_dict(self, state: State) -> None:
        """Continue from ``state_dict``; raise BidexError if the checkpoint was saved without a recording."""
        if _KEY not in state:
            raise BidexError("This checkpoint was saved without a recording. Start a new run to record one.")
        own = dict(state[_KEY])
        self.world.load_state_dict({name: value for name, value in state.items() if name != _KEY})
        if self._writer is not None:
            self._writer.close()
        self.open(self.folder, int(own.pop("parts")))
        self.load_collector_state(own)

    def close(self) -> None:
        """Drop the episodes that no checkpoint covers, and free the world."""
        if self._writer is not None:
            self._writer.close()
        super().close()


def spread_environments(world: VectorWorld, share: float) -> list[int]:
    """Choose environments to record: the given share, above 0, of the environments of each slot, at least one per slot.

    A slot is a class or a listed task. A share of 1 or more returns all environments.
    """
    chosen: list[int] = []
    slots = world.task_id.tolist()
    for slot in range(world.num_tasks):
        rows = [row for row, own in enumerate(slots) if own == slot]
        count = min(len(rows), max(1, round(share * len(rows))))
        chosen += [rows[number * len(rows) // count] for number in range(count)]
    return chosen

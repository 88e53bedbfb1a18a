"""A replay with a separate part for each task: the last vector steps of all environments, in a ring on the device.

A vector step is one step of all environments. An observation is stored once, as the end of one transition and the start
of the next; last observations before time limits are stored in a separate ring. No shape depends on data, and the host
never waits for the device.
"""

import math
import sys
from bisect import bisect_right
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bidex_meta.errors import BidexError
from bidex_meta.training.distributed import is_main
from bidex_meta.training.learner import State
from bidex_meta.world.contract import Info, VectorWorld


@dataclass
class Transitions:
    """B transitions as they were stored: raw observations, raw rewards."""

    obs: Tensor  # observations before the step (B, d)
    actions: Tensor  # actions (B, a)
    rewards: Tensor  # rewards (B,)
    next_obs: Tensor  # observations after the step, in the same episode (B, d); not used if terminated
    terminated: Tensor  # whether the step ended the episode, bool (B,); a time limit does not count
    steps: Tensor | int = 1  # number of steps from obs to next_obs, an int or (B,); rewards holds their discounted sum


class Replay:
    """The last ``steps`` vector steps of all environments, with a separate part per task (``task_id``, (N,)).

    ``cut_share`` is the space for last observations of episodes cut by a time limit, as a share of all transitions. If
    the space is too small, the transitions that lost their last observation get weight 0. ``added`` counts the vector
    steps added.
    """

    def __init__(
        self, steps: int, task_id: Tensor, num_tasks: int, observations: int, actions: int, device: torch.device,
        cut_share: float = 1 / 16
    ):  # fmt: skip
        rows = len(task_id)
        self.steps = steps
        self.rows = rows
        self.num_tasks = num_tasks
        self.device = device
        self.added = 0
        # One more than transitions, because no action has been taken from the newest observation yet.
        self.slots = steps + 1
        self.cuts_kept = _cuts_kept(steps, rows, cut_share)

        # The ring is not filled: memory is allocated at the first write, and no entry is read earlier.
        def ring(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.empty(shape, dtype=dtype, device=device)

        self._obs = ring(self.slots, rows, observations)
        self._steps = {
            "actions": ring(self.slots, rows, actions),
            "rewards": ring(self.slots, rows),
            "terminated": ring(self.slots, rows, dtype=torch.bool),
            "valid": ring(self.slots, rows, dtype=torch.bool),
            # This is the number, counted from 1, of the time limit that cut the episode here; 0 without a cut.
            "cut": ring(self.slots, rows, dtype=torch.int64),
        }
        # The last cell is a dummy for writes that are never read.
        self._final_obs = ring(self.cuts_kept + 1, observations)
        self._cuts = torch.zeros((), dtype=torch.int64, device=device)
        self._rows_of_task = torch.argsort(task_id, stable=True)
        self._count = torch.bincount(task_id, minlength=num_tasks)
        self._first = self._count.cumsum(0) - self._count

    @property
    def filled(self) -> int:
        """Return the number of stored vector steps from which :meth:`draw` chooses."""
        return min(self.added, self.steps)

    @property
    def obs(self) -> Tensor:
        """Return the newest observations, raw (N, d)."""
        return self._obs[self.added % self.slots]

    def begin(self, obs: Tensor) -> None:
        """Store the observations (N, d) from which the first step starts."""
        self.obs.copy_(obs)

    def add(
        self, actions: Tensor, reward: Tensor, terminated: Tensor, truncated: Tensor, obs: Tensor, info: Info
    ) -> None:
        """Add one step of all environments, which starts from the newest observations (``self.obs``).

        ``actions`` (N, a) are the actions of the step; the other arguments are the results of the world's ``step``.
        """
        valid = ~info["unstable"]
        cut = truncated & ~terminated & valid
        number = self._cuts + cut.cumsum(0)
        # All rows write, and rows whose episode continues write into the dummy cell. Selecting rows would make the host
        # wait.
        cell = torch.where(cut, (number - 1) % self.cuts_kept, self.cuts_kept)
        self._final_obs.index_copy_(0, cell, info["final_obs"])
        self._cuts += cut.sum()
        # A weight of 0 does not remove a reward that is NaN.
        rewards = reward.masked_fill(~valid, 0.0)
        numbers = number.masked_fill(~cut, 0)
        step = {"actions": actions, "rewards": rewards, "terminated": terminated, "valid": valid, "cut": numbers}
        for name, value in step.items():
            self._steps[name][self.added % self.slots] = value
        self.added += 1
        self.obs.copy_(obs)

    def draw(self, batches: int, per_task: int, generator: torch.Generator) -> Tensor:
        """Draw indices uniformly within each task: int64 (batches, num_tasks * per_task), ordered by task."""
        shape = (batches, self.num_tasks, per_task)

        def uniform(high: int) -> Tensor:
            return torch.randint(high, shape, generator=generator, device=self.device)

        # A remainder of this large number favours no row by more than 1 in 2^40 / rows.
        row = self._rows_of_task[self._first[:, None] + uniform(2**40) % self._count[:, None]]
        return self.places(row, uniform(self.filled)).flatten(1)

    def places(self, rows: Tensor, ages: Tensor) -> Tensor:
        """Return the int64 indices of the transitions of environments ``rows``, ``ages`` vector steps ago.

        The newest transition has age 0. ``rows`` and ``ages`` are broadcast against each other.
        """
        return (self.added - 1 - ages) % self.slots * self.rows + rows

    def weights(self, places: Tensor) -> Tensor:
        """Return the weight of each transition, float32, in the shape of ``places``.

        The weight is 0 if physics broke or if the episode's last observation is no longer kept, and 1 otherwise.
        """
        cut = self.at("cut", places)
        kept = (cut == 0) | (cut > self._cuts - self.cuts_kept)
        return (self.at("valid", places) & kept).float()

    def after(self, places: Tensor) -> Tensor:
        """Return the index of the same environment's next transition for each of ``places``, in the same shape."""
        return (places + self.rows) % (self.slots * self.rows)

    def take(self, places: Tensor, last: Tensor | None = None) -> Transitions:
        """Return the transitions at ``places`` (B,).

        With ``last`` (B,), the next observations and ``terminated`` are those of the transitions at ``last``.
        """
        if last is None:
            last = places
        everything = self._obs.flatten(0, 1)
        following = everything.index_select(0, self.after(last))
        cut = self.at("cut", last)
        final = self._final_obs.index_select(0, (cut - 1) % self.cuts_kept)
        return Transitions(
            obs=everything.index_select(0, places), actions=self.at("actions", places),
            rewards=self.at("rewards", places), next_obs=torch.where((cut > 0)[:, None], final, following),
            terminated=self.at("terminated", last)
        )  # fmt: skip

    def at(self, name: str, places: Tensor) -> Tensor:
        """Return a stored field (rewards, terminated, valid or cut) at ``places``, in the shape of ``places``."""
        return self._steps[name].flatten(0, 1)[places]

    def state_dict(self) -> State:
        """Return a copy of the stored data."""
        cuts = min(int(self._cuts), self.cuts_kept)
        return {
            "added": self.added, "steps": self.steps, "obs": self._obs[: self.added + 1].clone(),
            **{name: ring[: self.added].clone() for name, ring in self._steps.items()},
            "final_obs": self._final_obs[:cuts].clone(), "cuts": self._cuts.clone(),
        }  # fmt: skip

    def load_state_dict(self, state: State) -> None:
        """Restore the result of :meth:`state_dict`; raise BidexError if it comes from a replay of another size."""
        here = (self.steps, *self._obs.shape[1:])
        there = (state["steps"], *state["obs"].shape[1:])
        if here != there:
            raise BidexError(
                f"The checkpoint's replay had (steps, num_envs, observations) = {there}, this one has {here}. Resume "
                "with the run's own suite, num_envs and replay."
            )
        self.added = int(state["added"])
        self._obs[: self.added + 1] = state["obs"].to(self.device)
        for name, ring in self._steps.items():
            ring[: self.added] = state[name].to(self.device)
        self._final_obs[: len(state["final_obs"])] = state["final_obs"].to(self.device)
        self._cuts.copy_(state["cuts"])


def replay_bytes(steps: int, rows: int, observations: int, actions: int, cut_share: float = 1 / 16) -> int:
    """Return the bytes that a :class:`Replay` of this size takes."""
    transition = 4 * (observations + actions + 1) + 2 + 8
    return (steps + 1) * rows * transition + (_cuts_kept(steps, rows, cut_share) + 1) * 4 * observations


def steps_within(memory: float, steps: int, rows: int, observations: int, actions: int, cut_share: float) -> int:
    """Return the largest number of vector steps, up to ``steps``, that fits into ``memory`` bytes; 0 if none fits."""
    sizes = rows, observations, actions, cut_share
    return bisect_right(range(1, steps + 1), memory, key=lambda n: replay_bytes(n, *sizes))


def _cuts_kept(steps: int, rows: int, cut_share: float) -> int:
    # There is space for at least one vector step, because all episodes may end together, and a step must not write a
    # cell twice.
    return max(rows, math.ceil(cut_share * steps * rows))


class Stretches:
    """Sequences of up to ``n`` consecutive transitions, which begin at the indices ``places``, int64 (batches, B).

    A sequence is shorter if its episode or the stored data end earlier. ``last`` holds the index of each sequence's
    last transition.
    """

    def __init__(self, replay: Replay, places: Tensor, n: int, gamma: float | Tensor):
        self.replay = replay
        self.first = places
        self.last = places
        self.rewards: Tensor | None = None
        if n == 1:
            return
        newest = replay.added % replay.slots  # slot of an observation from which no step has been taken yet
        self.rewards = replay.at("rewards", self.first)
        self.steps = torch.ones_like(self.first)
        going = replay.at("valid", self.first) & ~self._ended(self.first)
        for _ in range(1, n):
            following = replay.after(self.last)
            going = going & (following // replay.rows != newest) & replay.at("valid", following)
            reward = replay.at("rewards", following) * gamma**self.steps
            self.rewards = self.rewards + reward.masked_fill(~going, 0.0)
            self.steps = self.steps + going
            self.last = torch.where(going, following, self.last)
            going = going & ~self._ended(self.last)

    def _ended(self, places: Tensor) -> Tensor:
        return self.replay.at("terminated", places) | (self.replay.at("cut", places) > 0)

    def take(self, batch: int) -> Transitions:
        """Return the sequences of one batch, each as a single transition over several steps, (B,).

        ``batch`` is the index of the batch.
        """
        taken = self.replay.take(self.first[batch], self.last[batch])
        if self.rewards is None:
            return taken
        return replace(taken, rewards=self.rewards[batch], steps=self.steps[batch])


def replay_within(
    learner: str, world: VectorWorld, observations: int, actions: int, asked: int, memory: float, share: float
) -> Replay:
    """Make a replay of ``asked`` vector steps, or of fewer steps if only those fit into ``memory`` (in 10^9 bytes).

    Raises BidexError if not even one step fits, or if a task has no environment.
    """
    rows = world.num_envs
    present = torch.bincount(world.task_id, minlength=world.num_tasks).tolist()
    if 0 in present:
        raise BidexError(f"{learner}: task {world.task_names[present.index(0)]} has no environments. Raise num_envs.")
    steps = steps_within(memory * 1e9, asked, rows, observations, actions, share)
    needed = replay_bytes(asked, rows, observations, actions, share) / 1e9
    if steps == 0:
        raise BidexError(
            f"{learner}: replay_memory {memory:g} GB is too little for one step of {rows} environments. Raise it."
        )
    if steps < asked and is_main():
        kept = f"it keeps {steps:,} ({steps * rows:,} transitions)."
        said = f"{learner}: a replay of {asked:,} vector steps ({asked * rows:,} transitions) needs {needed:.1f} GB; "
        print(f"{said}replay_memory is {memory:g} GB: {kept}", file=sys.stderr, flush=True)
    return Replay(steps, world.task_id, world.num_tasks, observations, actions, world.device, share)

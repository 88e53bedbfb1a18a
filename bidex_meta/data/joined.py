"""Data sets in memory as one, in the form of the world that a policy is learned for.

Observations of an episode stand one behind the other, each once: a transition leads from its place to the next one.
That is half of what two tensors of observations would take.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bidex_meta.data.dataset import Dataset
from bidex_meta.data.episode import Episode
from bidex_meta.errors import BidexError, unknown_name
from bidex_meta.memory import check_memory
from bidex_meta.world.contract import VectorWorld


@dataclass(frozen=True)
class Joined:
    """N transitions of E episodes, on the CPU."""

    observations: Tensor
    """All states, episode after episode, (N + E, d), float32."""
    at: Tensor
    """Place of each transition's observation, int64 (N,); the next observation stands behind it."""
    actions: Tensor
    """(N, a), float32."""
    rewards: Tensor
    """(N,), float32, in the world's scale."""
    terminated: Tensor
    """Whether the episode came to a true end, bool (N,)."""
    task: Tensor
    """Slot of the world, int64 (N,)."""
    left: Tensor
    """Transitions of the same episode behind this one, int64 (N,)."""

    def __len__(self) -> int:
        """Transitions, N."""
        return len(self.rewards)

    def fingerprint(self) -> dict[str, float]:
        """Numbers that other data would not share, for a checkpoint: a run goes on with its own data."""
        sums = {"rewards": self.rewards, "actions": self.actions, "task": self.task}
        return {"transitions": len(self), **{name: float(each.sum(dtype=torch.float64)) for name, each in sums.items()}}


def join(datasets: Sequence[Dataset], world: VectorWorld, every: bool = True) -> Joined:
    """Reads data sets for a world.

    Classes are found by the names of their slots. Of a class recorded on its own, observations get the padding and the
    one-hot that the world shows, and rewards its scale.

    Args:
        datasets: At least one.
        world: It is neither stepped nor reset.
        every: Whether each of the world's classes needs data.

    Raises:
        BidexError: Actions or observations of another form, a class that the world does not have, one of the world's
            that no data set holds, or no room in memory.
    """
    ids = world.num_id_columns
    plain, actions = world.single_observation_space.shape[0] - ids, world.single_action_space.shape[0]
    forms = [_Form(each, world, plain, actions) for each in datasets]
    steps, episodes = (sum(getattr(each, name) for each in datasets) for name in ("num_steps", "num_episodes"))
    found = {each.slots[task] for each in forms for task in np.unique(each.dataset.table["task"])}
    missing = [name for slot, name in enumerate(world.task_names) if slot not in found]
    if missing and every:
        raise BidexError(
            f"Expected data of every class, found none of {', '.join(missing)}. Add a data set, or name a suite of the "
            "others alone."
        )
    needed = 4 * (steps + episodes) * (plain + ids) + steps * (4 * (actions + 1) + 1 + 3 * 8)
    check_memory(needed, f"The {steps:,} transitions", "Name fewer data sets, or record smaller ones.")
    taken = (form.fitted(episode, ids) for form in forms for episode in form.dataset.episodes())
    return gathered(taken, steps, episodes, plain + ids, actions)


def gathered(
    episodes: Iterable[tuple[Episode, int, np.ndarray]], steps: int, count: int, observations: int, actions: int
) -> Joined:
    """Puts episodes behind each other.

    Args:
        episodes: Each with its slot, and observations (T + 1, d) as the world would show them.
        steps: Transitions of all.
        count: How many they are.
        observations: Entries of an observation, d.
        actions: Actions, a.
    """
    states, acts, rewards = torch.empty(steps + count, observations), torch.empty(steps, actions), torch.empty(steps)
    at, task, left = torch.empty(3, steps, dtype=torch.int64).unbind()
    ends = torch.empty(steps, dtype=torch.bool)
    start = 0
    for number, (episode, slot, seen) in enumerate(episodes):
        length, first = len(episode), start + number
        where = slice(start, start + length)
        states[first : first + length + 1] = torch.from_numpy(seen)
        for own, given in ((acts, episode.actions), (rewards, episode.rewards), (ends, episode.terminated)):
            own[where] = torch.from_numpy(given)
        at[where] = torch.arange(first, first + length)
        left[where], task[where] = torch.arange(length - 1, -1, -1), slot
        start += length
    return Joined(states, at, acts, rewards, ends, task, left)


class _Form:
    """How a data set's episodes become a world's.

    Args:
        dataset: The data set.
        world: The world.
        plain: Entries of the world's observation without its one-hot.
        actions: The world's actions.

    Attributes:
        slots: The world's slot for each of the data set's.
    """

    def __init__(self, dataset: Dataset, world: VectorWorld, plain: int, actions: int) -> None:
        self.dataset, about = dataset, dataset.metadata
        names: list[str] = about["tasks"]
        self.slots = list(_slots(names, world, outside=about["kind"] == "outside"))
        if dataset.action_size != actions:
            raise BidexError(
                f"{dataset.name} has {dataset.action_size} actions, the world {actions}. Record it with the same bases "
                "(--base), or learn for what it was recorded of."
            )
        shown = {
            name: sum(stop - start for start, stop in parts) for name, parts in about.get("observation_groups", ())
        }
        self._plain, self._width = dataset.observation_size - shown.get("task_id", 0), plain
        padded = self._plain < plain and world.num_tasks > 1 and len(names) == 1
        if self._plain != plain and not padded:
            raise BidexError(
                f"{dataset.name} has observations of {self._plain} entries beside the task id, the world {plain}. "
                "Learn for what it was recorded of."
            )
        own, theirs = about.get("reward_scales", {}), {s.name: s.reward_scale for s in getattr(world, "slots", ())}
        self._factors = [
            theirs.get(world.task_names[slot], 1.0) / own.get(name, 1.0) if own and theirs else 1.0
            for name, slot in zip(names, self.slots, strict=True)
        ]

    def fitted(self, episode: Episode, ids: int) -> tuple[Episode, int, np.ndarray]:
        """An episode, its slot, and its observations in the world's form."""
        slot, factor = self.slots[episode.task], self._factors[episode.task]
        seen = episode.observations[:, : self._plain]
        if self._width + ids != seen.shape[1]:
            wide = np.zeros((len(seen), self._width + ids), np.float32)
            wide[:, : self._plain] = seen
            if ids:
                wide[:, self._width + slot] = 1.0
            seen = wide
        if factor != 1.0:
            episode.rewards[:] *= np.float32(factor)
        return episode, slot, seen


def _slots(names: Sequence[str], world: Any, outside: bool) -> Iterator[int]:
    """The world's slot of each name."""
    if outside and world.num_tasks == 1:
        yield from [0] * len(names)
        return
    known: Mapping[str, int] = {name: slot for slot, name in enumerate(world.task_names)}
    for name in names:
        if name not in known:
            raise unknown_name("class in the world of", name, known)
        yield known[name]

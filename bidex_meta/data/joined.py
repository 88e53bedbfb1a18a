"""Join data sets in memory for training, in the form that the world gives to observations, actions and rewards.

Each observation is stored once, although it belongs to two transitions.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bidex_meta.data.dataset import Dataset
from bidex_meta.data.part_files import Episode
from bidex_meta.engine.models import model_identity
from bidex_meta.errors import BidexError, shortened, unknown_name
from bidex_meta.tasks.registry import name_among
from bidex_meta.tasks.scene import compile_without_touch
from bidex_meta.utils.memory import check_memory
from bidex_meta.world.contract import VectorWorld
from bidex_meta.world.depth_sensor import POINT_ENTRIES
from bidex_meta.world.groups import Slot


@dataclass(frozen=True)
class Joined:
    """N transitions of E episodes, on the CPU."""

    observations: Tensor  # all states, episode after episode, (N + E, d), float32
    at: Tensor  # row of each transition's observation, int64 (N,); the next row is its next observation
    actions: Tensor  # (N, a), float32
    rewards: Tensor  # (N,), float32, in the world's scale
    terminated: Tensor  # whether the episode came to a true end, bool (N,)
    task: Tensor  # slot of the world, int64 (N,)
    left: Tensor  # number of later transitions of the same episode, int64 (N,)

    def __len__(self) -> int:
        """Return the number of transitions, N."""
        return len(self.rewards)

    def fingerprint(self) -> dict[str, float]:
        """Return checksums of the data.

        A checkpoint stores them, so that its run is only resumed with the same data.
        """
        parts = {"rewards": self.rewards, "actions": self.actions, "task": self.task}
        sums = {name: float(part.sum(dtype=torch.float64)) for name, part in parts.items()}
        return {"transitions": len(self), **sums}


def join(datasets: Sequence[Dataset], world: VectorWorld, every: bool = True) -> Joined:
    """Load data sets in the form of a world's observations, actions and rewards; the world is not stepped or reset.

    At least one data set is needed. Classes are matched by name. Observations get the world's task id and, if a class
    was recorded on its own, the world's padding. Rewards get the world's scale. Goals that the world hides become zero.
    Actions that another library recorded are mapped from their bounds to [-1, 1]. If ``every`` is True, each of the
    world's classes needs data.

    BidexError is raised if actions, states, touch sensors or point clouds do not fit the world, if another library's
    actions have no bounds, if classes do not match, if the physics of a class has changed since it was recorded, if
    there are no transitions or some numbers are not finite, or if memory is too small.
    """
    ids = world.num_id_columns
    plain = world.single_observation_space.shape[0] - ids
    actions = world.single_action_space.shape[0]
    forms = [_Form(dataset, world, plain, actions) for dataset in datasets]
    steps = sum(dataset.num_steps for dataset in datasets)
    episodes = sum(dataset.num_episodes for dataset in datasets)
    slots = set[int]()
    for form in forms:
        table = form.dataset.table
        slots |= {form.slots[task] for task in np.unique(table["task"][table["steps"] > 0])}
    missing = [name for slot, name in enumerate(world.task_names) if slot not in slots]
    if missing and every:
        fault = f"Expected data of every class, found none of {', '.join(missing)}"
        raise BidexError(f"{fault}. Add a data set, or name a suite of the others alone.")
    if not slots:
        names = ", ".join(dataset.name for dataset in datasets)
        raise BidexError(f"{names}: expected at least one transition, got none. Record them again.")
    needed = 4 * (steps + episodes) * (plain + ids) + steps * (4 * (actions + 1) + 1 + 3 * 8)
    check_memory(needed, f"The {steps:,} transitions", "Name fewer data sets, or record smaller ones.")
    fitted = chain.from_iterable(form.fitted_episodes(ids) for form in forms)
    return gathered(fitted, steps, episodes, plain + ids, actions)


def gathered(
    episodes: Iterable[tuple[Episode, int, np.ndarray]], steps: int, count: int, observations: int, actions: int
) -> Joined:
    """Join episodes into one set of transitions.

    Each item of ``episodes`` has an episode, its slot (class or listed task) in the world, and its observations (T + 1,
    d) in the world's form. ``steps`` and ``count`` are the numbers of transitions and episodes; ``observations`` and
    ``actions`` are sizes. Raises BidexError if the episodes have fewer than ``steps`` transitions.
    """
    states = torch.zeros(steps + count, observations)
    acts = torch.zeros(steps, actions)
    rewards = torch.zeros(steps)
    at, task, left = torch.zeros(3, steps, dtype=torch.int64).unbind()
    ends = torch.zeros(steps, dtype=torch.bool)
    start = 0
    for number, (episode, slot, seen) in enumerate(episodes):
        length = len(episode)
        first = start + number
        where = slice(start, start + length)
        states[first : first + length + 1] = torch.from_numpy(seen)
        for own, given in ((acts, episode.actions), (rewards, episode.rewards), (ends, episode.terminated)):
            own[where] = torch.from_numpy(given)
        at[where] = torch.arange(first, first + length)
        left[where] = torch.arange(length - 1, -1, -1)
        task[where] = slot
        start += length
    if start != steps:
        raise BidexError(f"Expected {steps:,} transitions, got {start:,}. Check the data sets: bidex-meta data check.")
    return Joined(states, at, acts, rewards, ends, task, left)


def check_touch(dataset: Dataset, touch: bool) -> None:
    """Raise BidexError unless a data set and a world both show touch sensors (``touch``), or neither does.

    Otherwise padding would hide that the widths differ.
    """
    if bool(dataset.metadata.get("touch")) != touch:
        if touch:
            raise BidexError(f"{dataset.name} shows no touch sensors, the world here does. Leave --touch out.")
        raise BidexError(f"{dataset.name} shows touch sensors, the world here does not. Add --touch.")


def class_physics(slots: Iterable[Slot]) -> dict[str, str]:
    """Return, by class, the digest of the physics (``engine.models.model_identity``) of a world's slots.

    Touch sensors do not change the digest.
    """
    classes = {slot.name.partition("/")[0]: slot.task_class for slot in slots}
    return {name: model_identity(compile_without_touch(task_class)) for name, task_class in classes.items()}


class _Columns(NamedTuple):
    """Columns of an observation that hold the state, and columns that hold the point cloud; the task id is left out.

    Padding belongs to the state and comes before the point cloud.
    """

    state: np.ndarray  # columns of the state, that is, all but the cloud, ascending
    cloud: np.ndarray  # columns of the point cloud, point after point
    label: str  # form of the cloud, for messages

    @staticmethod
    def of(groups: Iterable[tuple[str, Sequence[tuple[int, int]]]], size: int) -> "_Columns":
        """Return which columns of an observation with ``size`` entries hold the state, and which hold the point cloud.

        ``groups`` lists the name and the index ranges of each observation group.
        """
        every = np.arange(size)
        for name, parts in groups:
            if name in POINT_ENTRIES:
                cloud = np.concatenate([np.arange(start, stop) for start, stop in parts])
                label = f"{name} of {len(cloud) // POINT_ENTRIES[name]:,}"
                return _Columns(np.setdiff1d(every, cloud), cloud, label)
        return _Columns(every, every[:0], "none")


class _Form:
    """Converts a data set's episodes to the form of a world's observations, actions and rewards.

    ``plain`` is the size of the world's observations without the task id, and ``actions`` is the number of the world's
    actions. ``slots`` has the world's slot (class or listed task) for each slot of the data set.
    """

    def __init__(self, dataset: Dataset, world: VectorWorld, plain: int, actions: int) -> None:
        self.dataset = dataset
        about = dataset.metadata
        names: list[str] = about["tasks"]
        self.slots = list(_slots(names, world, outside=about["kind"] == "outside"))
        if dataset.action_size != actions:
            fault = f"{dataset.name} has {dataset.action_size} actions, the world {actions}"
            raise BidexError(
                f"{fault}. Record it with the same bases (--base), or train on the tasks that it was recorded on."
            )
        shown = about.get("observation_groups", ())
        ids = sum(stop - start for start, stop in dict(shown).get("task_id", ()))
        self._width = plain
        self._own = _Columns.of(shown, dataset.observation_size - ids)
        groups = [(group.name, [(part.start, part.stop) for part in group.where]) for group in world.observation_groups]
        self._theirs = _Columns.of(groups, plain)
        self._bounds = dataset.action_bounds
        hide = getattr(world, "hides_goals", False) and not about.get("hides_goals", True)
        slots: Sequence[Slot] = getattr(world, "slots", ())  # Meta-World's worlds have no slots
        self._hidden = [slots[slot].task_class.layout.goal_indices() if hide else [] for slot in self.slots]
        check_touch(dataset, any(slot.task_class.touch for slot in slots))
        self._check_observations(world.num_tasks > 1 and len(names) == 1)
        self._check_physics(slots)
        own = about.get("reward_scales", {})
        theirs = {slot.name: slot.reward_scale for slot in slots}
        self._factors = [1.0] * len(names)
        if own and theirs:
            for number, (name, slot) in enumerate(zip(names, self.slots, strict=True)):
                self._factors[number] = theirs.get(world.task_names[slot], 1.0) / own.get(name, 1.0)

    def _check_observations(self, may_pad: bool) -> None:
        """Raise BidexError if the data set's point clouds or state sizes differ from the world's.

        With ``may_pad`` the world's states may be wider, because padding fills the remaining columns.
        """
        name = self.dataset.name
        own = self._own
        theirs = self._theirs
        if own.label != theirs.label:
            mend = "Learn with the points that it was recorded with (--points, or [points] in the suite's file)"
            raise BidexError(f"{name} has point clouds: {own.label}, the world: {theirs.label}. {mend}.")
        here = len(own.state)
        there = len(theirs.state)
        if here > there or (here < there and not may_pad):
            fault = f"{name} has observations of {here} entries beside the task id and cloud, the world {there}"
            raise BidexError(f"{fault}. Train on the tasks that it was recorded on.")

    def _check_physics(self, slots: Sequence[Slot]) -> None:
        """Raise BidexError if a class's physics differs from the physics with which the data set was recorded.

        Older data sets, and those from elsewhere, do not store the physics; they are accepted.
        """
        about = self.dataset.metadata
        recorded: Mapping[str, str] = about.get("physics", {})
        if not recorded or not slots:
            return
        classes = {}
        for name, slot in zip(about["tasks"], self.slots, strict=True):
            classes[name.partition("/")[0]] = slots[slot]
        for name, slot in classes.items():
            (here,) = class_physics([slot]).values()
            if (then := recorded.get(name, here)) != here:
                raise BidexError(
                    f"{self.dataset.name}: expected the physics of {name} as recorded ({shortened(then)}), got {here}: "
                    "its object, suite file or code has changed. Restore it, or record the data set again."
                )

    def fitted_episodes(self, ids: int) -> Iterator[tuple[Episode, int, np.ndarray]]:
        """Yield each episode, the index of its task in the world, and its observations in the world's form.

        ``ids`` is the size of the world's task id. Raises BidexError for numbers that are not finite.
        """
        for number, episode in enumerate(self.dataset.episodes()):
            fitted, slot, seen = self._fitted(episode, ids)
            self.dataset.check_finite(number, seen, episode.actions, fitted.rewards)
            yield fitted, slot, seen

    def _fitted(self, episode: Episode, ids: int) -> tuple[Episode, int, np.ndarray]:
        slot = self.slots[episode.task]
        factor = self._factors[episode.task]
        own = self._own
        theirs = self._theirs
        seen = np.zeros((len(episode) + 1, self._width + ids), np.float32)
        seen[:, theirs.state[: len(own.state)]] = episode.observations[:, own.state]
        seen[:, theirs.cloud] = episode.observations[:, own.cloud]
        seen[:, theirs.state[self._hidden[episode.task]]] = 0.0
        if ids:
            seen[:, self._width + slot] = 1.0
        if self._bounds is not None:
            low, high = self._bounds
            # The data set's own environment clips actions in the same way.
            mapped = (episode.actions - (high / 2.0 + low / 2.0)) / (high / 2.0 - low / 2.0)
            episode = replace(episode, actions=mapped.clip(-1.0, 1.0))
        if factor != 1.0:
            episode.rewards[:] *= np.float32(factor)
        return episode, slot, seen


def _slots(names: Sequence[str], world: VectorWorld, outside: bool) -> Iterator[int]:
    """Yield, for each name of a class or listed task in a data set, the index of this name in the world.

    With ``outside``, another library recorded the data. In a world with a single task, all names then have index 0.
    Raises BidexError for a name that the world does not have.
    """
    if outside and world.num_tasks == 1:
        yield from [0] * len(names)
        return
    known: Mapping[str, int] = {name: slot for slot, name in enumerate(world.task_names)}
    classes = {slot.name: slot.task_class for slot in getattr(world, "slots", ())}  # Meta-World's worlds have no slots
    for name in names:
        here = name_among(name, classes)
        if here not in known:
            raise unknown_name("class in the world of", name, known)
        yield known[here]

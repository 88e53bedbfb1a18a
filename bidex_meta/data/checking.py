"""Checks of a data set: files are as they were written, episodes whole, rewards follow from what was observed.

The reward is computed again by the class's own formula (``TaskClass.reward_terms``), from sensors that the observation
shows and the variation that the episode stores; so it holds observations, variations and rewards to each other, where
an error of the recorder (a shifted row, a wrong task, a wrong start) would part them. A formula that asks for more
than the observation shows (the hand's point of most table classes; with point clouds the objects' states) cannot be
computed again, and the check says so.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bidex_meta.data.dataset import Dataset
from bidex_meta.data.episode import Episode
from bidex_meta.errors import BidexError
from bidex_meta.outside import name_without_object
from bidex_meta.points.sight import POINT_ENTRIES
from bidex_meta.points.told import entries_of_objects
from bidex_meta.tasks import registry
from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.layout import CLIP, Block
from bidex_meta.tasks.scene import compile_scene
from bidex_meta.tasks.state import TaskState

_TOLERANCE = 1e-5
"""Of a reward, beside the same share of its size: observations and, on a GPU, the formula are float32. Measured on the
CPU: 2e-8."""
_EXAMPLES = 5


@dataclass
class Findings:
    """What a check found.

    Attributes:
        episodes: Episodes looked at.
        steps: Their transitions.
        wrong: What is wrong, a line for each of the first few episodes of each kind.
        count: How many episodes are wrong.
        recomputed: Transitions whose reward was computed again, by class.
        largest: Largest difference between a stored reward and a computed one, in the formula's units, by class.
        skipped: Why rewards of a class were not computed again, by class.
        unsealed: Files that carry no digest.
    """

    episodes: int = 0
    steps: int = 0
    wrong: list[str] = field(default_factory=list)
    count: int = 0
    recomputed: dict[str, int] = field(default_factory=dict)
    largest: dict[str, float] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    unsealed: list[str] = field(default_factory=list)


class _Unseen(Exception):
    """The formula asks for a sensor that the observation does not show."""


class _Seen(TaskState):
    """The state as far as an observation shows it.

    Args:
        shown: Where each sensor stands in an observation, and the factor that it was shown with.
        observations: (n, d), float64.
        frozen: What the class computed of each row's variation.
    """

    def __init__(
        self, shown: Mapping[str, tuple[slice, float]], observations: Tensor, frozen: dict[str, Tensor]
    ) -> None:
        super().__init__(observations, {}, frozen)
        self._shown, self.clipped = shown, torch.zeros(len(observations), dtype=torch.bool)

    def __getitem__(self, name: str) -> Tensor:
        if name not in self._shown:
            raise _Unseen(name)
        where, scale = self._shown[name]
        values = self._sensors[:, where]
        self.clipped |= (values.abs() >= CLIP).any(1)
        return values / scale

    def quaternion(self, name: str) -> Tensor:
        # Observations show (x, y, z, w) already.
        return self[name]


def verify(dataset: Dataset, most: int | None = None) -> Findings:
    """Checks every file's digest, and every episode.

    Args:
        dataset: What to check.
        most: Episodes to look at at most, from 1 on, evenly spread; None: all.

    Raises:
        BidexError: Files are missing or damaged.
    """
    found, task_classes = Findings(unsealed=dataset.check_digests()), _Formulas(dataset)
    table, every = dataset.table, 1 if most is None else max(1, math.ceil(dataset.num_episodes / most))
    for number, episode in enumerate(dataset.episodes()):
        if number % every:
            continue
        found.episodes += 1
        found.steps += len(episode)
        told = list(_faults(episode, {name: column[number] for name, column in table.items()}, dataset))
        told += list(task_classes.check(episode, found))
        found.count += bool(told)
        if told and len(found.wrong) < _EXAMPLES:
            found.wrong.append(f"episode {number} ({episode.task_name}): {'; '.join(told)}")
    return found


def _faults(episode: Episode, row: Mapping[str, Any], dataset: Dataset) -> Iterator[str]:
    """What is wrong with an episode by itself."""
    steps = len(episode)
    if steps == 0:
        yield "no transition"
        return
    for name in ("observations", "actions", "rewards"):
        if not np.isfinite(getattr(episode, name)).all():
            yield f"{name} that are not finite"
    if "reward_scales" in dataset.metadata and np.abs(episode.actions).max() > 1.0:
        yield "actions outside [-1, 1]"
    ends = episode.terminated.astype(int) + episode.truncated
    if ends[-1] != 1 or ends[:-1].any():
        yield "not exactly one end, at its last transition"
    if episode.broken and not episode.truncated[-1]:
        yield "broken, but not truncated"
    total = float(episode.rewards.sum(dtype=np.float64))
    if int(row["steps"]) != steps or not np.isclose(float(row["return"]), total, rtol=1e-9, atol=1e-9):
        yield f"a table that says {int(row['steps'])} steps and return {float(row['return']):.6g}, found {total:.6g}"
    scale = dataset.metadata.get("reward_scales", {}).get(episode.task_name)
    if scale and not np.isclose(total, scale * episode.return_unscaled, rtol=1e-3, atol=1e-3 * steps):
        yield f"return {total:.6g} is not {scale:g} times the unscaled {episode.return_unscaled:.6g}"


class _Formulas:
    """The formulas of a data set's classes.

    Args:
        dataset: Whose episodes are checked.
    """

    def __init__(self, dataset: Dataset) -> None:
        self._dataset, about = dataset, dataset.metadata
        self._scales = about.get("reward_scales", {})
        told = {"own": (None,), "moving": (True,), "fixed": (False,)}
        # What a suite says of bases stands in its file, which may have gone; its actions tell.
        self._bases = told.get(about.get("base") or "", (True, None))
        self._clouds = any(name in POINT_ENTRIES for name, _ in about.get("observation_groups", ()))
        self._known: dict[str, tuple[TaskClass, dict[str, tuple[slice, float]]] | None] = {}

    def check(self, episode: Episode, found: Findings) -> Iterator[str]:
        """What is wrong with an episode's rewards; notes in ``found`` what was computed."""
        name = episode.task_name.partition("/")[0]
        known = self._of(name, found)
        scale = self._scales.get(episode.task_name)
        if known is None or not scale:
            found.skipped.setdefault(name, "its formula is not known here")
            return
        task, shown = known
        variation = torch.from_numpy(np.array(episode.variation, np.float64)).expand(len(episode), -1)
        observations = torch.from_numpy(episode.observations[1:].astype(np.float64))
        state = _Seen(shown, observations, task.freeze(variation))
        try:
            reward = torch.stack(list(task.reward_terms(state).values())).sum(0)
        except _Unseen as unseen:
            found.skipped[name] = f"its formula asks for {unseen}, which no observation shows"
            self._known[name] = None
            return
        stored = torch.from_numpy(episode.rewards.astype(np.float64)) / scale
        difference = (reward - stored).abs().masked_fill(state.clipped, 0.0)
        found.recomputed[name] = found.recomputed.get(name, 0) + int((~state.clipped).sum())
        found.largest[name] = max(found.largest.get(name, 0.0), float(difference.max()))
        late = difference > _TOLERANCE * (1.0 + stored.abs())
        if bool(late.any()):
            step = int(late.nonzero()[0])
            yield f"reward {float(stored[step]):.6g} at step {step}, but the formula gives {float(reward[step]):.6g}"

    def _of(self, name: str, found: Findings) -> tuple[TaskClass, dict[str, tuple[slice, float]]] | None:
        if name not in self._known:
            self._known[name] = None
            try:
                task = self._class(name_without_object(name))
                self._known[name] = task, shown_sensors(task, hidden=self._hidden(task))
            except BidexError as error:
                found.skipped[name] = str(error)
        return self._known[name]

    def _class(self, name: str) -> TaskClass:
        """A class with the bases of the recording.

        Raises:
            BidexError: It is unknown, or has other actions than the data with any of them.
        """
        classes, actions = [registry.get(name, base) for base in self._bases], self._dataset.action_size
        for task in classes:
            if task.action_size == actions:
                return task
        sizes = " or ".join(str(size) for size in sorted({task.action_size for task in classes}))
        raise BidexError(f"{name} has {sizes} actions here, the data {actions}")

    def _hidden(self, task: TaskClass) -> frozenset[int]:
        """Entries of a class's observation that are zero since clouds stand in their place."""
        return frozenset(entries_of_objects(compile_scene(task)) if self._clouds else ())


def shown_sensors(task: TaskClass, hidden: frozenset[int] = frozenset()) -> dict[str, tuple[slice, float]]:
    """Where a class's observation shows each sensor whole and unmapped, and the factor on it.

    Args:
        task: The class.
        hidden: Entries that show nothing.
    """
    found: dict[str, tuple[slice, float]] = {}
    for block, where in task.layout:
        if block.sensors and not block.name.endswith("joint_position"):  # those are mapped from the joint's range
            start = where.start
            for sensor in block.sensors:
                size = _size(block, sensor)
                if hidden.isdisjoint(range(start, start + size)):
                    found[sensor] = slice(start, start + size), block.scale
                start += size
    return found


def _size(block: Block, sensor: str) -> int:
    if len(block.sensors) == block.size:
        return 1
    return 4 if sensor.endswith("quaternion") else block.size if len(block.sensors) == 1 else 3

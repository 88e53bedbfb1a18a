"""Checks and summaries of a data set.

The check recomputes the rewards with the reward formula of each class. The formula reads sensors, which the check takes
from the observations, and values of the task, which the episode stores. A reward that differs shows that a transition
was stored with a wrong environment, task or start. If a formula reads a sensor that the observations do not show, the
check cannot recompute the rewards and reports this. Most classes with a table in the scene are such cases, because
their formulas read a point of the hand. Data with point clouds are such cases too, because the clouds replace the
states of objects.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from bidex_meta.data.dataset import Dataset
from bidex_meta.data.part_files import Episode, Json
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.references import Reference
from bidex_meta.rules import Rules
from bidex_meta.tasks import registry
from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.layout import CLIP, Block
from bidex_meta.tasks.scene import compile_scene
from bidex_meta.tasks.state import TaskState
from bidex_meta.utils.plugins import name_without_object
from bidex_meta.world.depth_sensor import POINT_ENTRIES, privileged_columns

_TOLERANCE = 1e-5
"""Absolute and relative tolerance of a recomputed reward, because observations and, on a GPU, the formula are float32.
The measured error on the CPU is 2e-8."""
_EXAMPLES = 5
_MOST_COVERED = 2000
_Shown = dict[str, tuple[slice, float]]


@dataclass
class Findings:
    """Result of the check of a data set."""

    episodes: int = 0  # checked episodes
    steps: int = 0  # checked transitions
    wrong: list[str] = field(default_factory=list)  # faults, one line for each of the first few wrong episodes
    count: int = 0  # wrong episodes
    recomputed: dict[str, int] = field(default_factory=dict)  # transitions whose reward was computed again, by class
    largest: dict[str, float] = field(default_factory=dict)
    """Largest difference between a stored reward and a computed one, in the formula's units, by class."""
    skipped: dict[str, str] = field(default_factory=dict)  # by class, why its rewards were not computed again
    unsealed: list[str] = field(default_factory=list)  # files without a digest


class _NotShown(Exception):
    """The formula reads a sensor that the observation does not show."""


class _ShownState(TaskState):
    """The part of the state that observations (n, d), float64, show; ``shown`` maps sensors to observation entries."""

    def __init__(self, shown: _Shown, observations: Tensor, frozen: dict[str, Tensor]) -> None:
        super().__init__(observations, {}, frozen)
        self._shown = shown
        self.clipped = torch.zeros(len(observations), dtype=torch.bool)

    def __getitem__(self, name: str) -> Tensor:
        if name not in self._shown:
            raise _NotShown(name)
        where, scale = self._shown[name]
        values = self._sensors[:, where]
        self.clipped |= (values.abs() >= CLIP).any(1)
        return values / scale

    def quaternion(self, name: str) -> Tensor:
        # Observations already show quaternions as (x, y, z, w).
        return self[name]


def verify(dataset: Dataset, most: int | None = None) -> Findings:
    """Check all digests, and the contents of at most ``most`` evenly spread episodes (all if ``most`` is None).

    Raises BidexError if a file is damaged.
    """
    findings = Findings(unsealed=dataset.check_digests())
    formulas = _Formulas(dataset)
    table = dataset.table
    for number, episode in _spread_episodes(dataset, most):
        findings.episodes += 1
        findings.steps += len(episode)
        faults = list(_faults(episode, {name: column[number] for name, column in table.items()}, dataset))
        if len(episode):
            faults += list(formulas.check(episode, findings))
        findings.count += bool(faults)
        if faults and len(findings.wrong) < _EXAMPLES:
            findings.wrong.append(f"episode {number} ({episode.task_name}): {'; '.join(faults)}")
    return findings


def _spread_episodes(dataset: Dataset, most: int | None) -> Iterator[tuple[int, Episode]]:
    """Yield at most ``most`` evenly spread episodes (all if ``most`` is None), each with its number."""
    if most is None:
        every = 1
    else:
        every = max(1, math.ceil(dataset.num_episodes / most))
    yield from ((number, episode) for number, episode in enumerate(dataset.episodes()) if number % every == 0)


def _faults(episode: Episode, row: Mapping[str, np.ndarray], dataset: Dataset) -> Iterator[str]:
    """Yield the faults of an episode that can be found without the reward formula."""
    steps = len(episode)
    if steps == 0:
        yield "no transition"
        return
    for name in ("observations", "actions", "rewards"):
        if not np.isfinite(getattr(episode, name)).all():
            yield f"{name} that are not finite as float32"
    if "reward_scales" in dataset.metadata and np.abs(episode.actions).max() > 1.0:
        yield "actions outside [-1, 1]"
    ends = episode.terminated.astype(int) + episode.truncated
    if ends[-1] != 1 or ends[:-1].any():
        yield "not exactly one end, at its last transition"
    if episode.broken and not episode.truncated[-1]:
        yield "broken, but not truncated"
    total = float(episode.rewards.sum(dtype=np.float64))
    if int(row["steps"]) != steps or not np.isclose(float(row["return"]), total, rtol=1e-9, atol=1e-9):
        yield f"a table with {int(row['steps'])} steps and return {float(row['return']):.6g}, found {total:.6g}"
    scale = dataset.metadata.get("reward_scales", {}).get(episode.task_name)
    if scale and not np.isclose(total, scale * episode.return_unscaled, rtol=1e-3, atol=1e-3 * steps):
        yield f"return {total:.6g} is not {scale:g} times the unscaled {episode.return_unscaled:.6g}"


class _Formulas:
    """The reward formulas of a data set's classes."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        about = dataset.metadata
        self._scales = about.get("reward_scales", {})
        self._rules = Rules(**about.get("rules", {}))
        # The suite's file says whether bases move. If that file is gone, the number of actions shows whether they do.
        self._bases = {"own": (None,), "moving": (True,), "fixed": (False,)}.get(about.get("base") or "", (True, None))
        self._touch = bool(about.get("touch"))
        self._noisy = bool((about.get("randomisation") or {}).get("observation_noise"))
        self._clouds = any(name in POINT_ENTRIES for name, _ in about.get("observation_groups", ()))
        self._known: dict[str, tuple[TaskClass, _Shown] | None] = {}

    def check(self, episode: Episode, findings: Findings) -> Iterator[str]:
        """Yield the faults of an episode's rewards, and add the recomputed transitions to ``findings``."""
        name = episode.task_name.partition("/")[0]
        known = self._of(name, findings)
        scale = self._scales.get(episode.task_name)
        if known is None or not scale:
            findings.skipped.setdefault(name, "its formula is not known here")
            return
        if self._noisy:
            findings.skipped[name] = "its observations have noise"
            return
        task, shown = known
        variation = torch.from_numpy(np.array(episode.variation, np.float64)).expand(len(episode), -1)
        observations = torch.from_numpy(episode.observations[1:].astype(np.float64))
        state = _ShownState(shown, observations, task.frozen(variation))
        try:
            reward = torch.stack(list(task.rewards(state).values())).sum(0)
        except _NotShown as error:
            findings.skipped[name] = f"its formula asks for {error}, which no observation shows"
            self._known[name] = None
            return
        stored = torch.from_numpy(episode.rewards.astype(np.float64)) / scale
        difference = (reward - stored).abs().masked_fill(state.clipped, 0.0)
        findings.recomputed[name] = findings.recomputed.get(name, 0) + int((~state.clipped).sum())
        findings.largest[name] = max(findings.largest.get(name, 0.0), float(difference.max()))
        late = difference > _TOLERANCE * (1.0 + stored.abs())
        if bool(late.any()):
            step = int(late.nonzero()[0])
            yield f"reward {float(stored[step]):.6g} at step {step}, but the formula gives {float(reward[step]):.6g}"

    def _of(self, name: str, findings: Findings) -> tuple[TaskClass, _Shown] | None:
        if name not in self._known:
            self._known[name] = None
            try:
                task = self._class(name_without_object(name))
                self._known[name] = task, shown_sensors(task, hidden=self._hidden(task))
            except BidexError as error:
                findings.skipped[name] = str(error)
        return self._known[name]

    def _class(self, name: str) -> TaskClass:
        """Return the task class ``name`` with fixed or with moving bases, whichever has the data's number of actions.

        Raises BidexError if neither class has this number of actions.
        """
        classes = [registry.get(name, base, self._touch) for base in self._bases]
        actions = self._dataset.action_size
        for task in classes:
            if task.action_size == actions:
                task.adopt(self._rules)
                return task
        sizes = " or ".join(str(size) for size in sorted({task.action_size for task in classes}))
        raise BidexError(f"{name} has {sizes} actions here, the data {actions}")

    def _hidden(self, task: TaskClass) -> frozenset[int]:
        return frozenset(privileged_columns(compile_scene(task)) if self._clouds else ())


def shown_sensors(task: TaskClass, hidden: frozenset[int] = frozenset()) -> _Shown:
    """Return the sensors whose values can be read back from an observation.

    Each name is mapped to a slice of the observation and to the factor by which the sensor's values were multiplied.
    Three kinds of sensors are left out: sensors with entries in ``hidden`` (indices of the observation), joint
    positions, which the observation maps from the joint's range, and sensors in blocks of the observation that
    saturate.
    """
    shown: _Shown = {}
    for block, where in task.layout:
        if block.sensors and not block.saturates and not block.name.endswith("joint_position"):
            start = where.start
            for sensor in block.sensors:
                size = _size(block, sensor)
                if hidden.isdisjoint(range(start, start + size)):
                    shown[sensor] = slice(start, start + size), block.scale
                start += size
    return shown


def _size(block: Block, sensor: str) -> int:
    if len(block.sensors) == block.size:
        return 1
    if sensor.endswith("quaternion"):
        return 4
    if len(block.sensors) == 1:
        return block.size
    return 3


@dataclass(frozen=True)
class SlotSummary:
    """Summary of the episodes of one slot of a data set; a slot is a class, or a class and one of its listed tasks."""

    name: str  # class, or class and task
    episodes: int
    steps: int
    length: float  # mean length of an episode, steps
    returns: tuple[float, float, float, float]  # unscaled: least, median, mean, largest
    success: float  # share of episodes that met their goal
    score: float | None  # mean score (``evaluation.references``); None if a reference is missing
    tasks: int  # number of different tasks
    broken: int  # episodes ended by broken physics


def summary(dataset: Dataset) -> list[SlotSummary]:
    """Summarise each slot (a class, or a class and a listed task) that has episodes.

    Only the tables of the data set are read, not its transitions.
    """
    table = dataset.table
    summaries = []
    for number, name in enumerate(dataset.metadata["tasks"]):
        own = table["task"] == number
        if not own.any():
            continue
        returns = table["return_unscaled"][own]
        steps = table["steps"][own]
        scores = None
        if known := dataset.metadata.get("references", {}).get(name.partition("/")[0]):
            values = [known.get(name) for name in ("random", "expert", "zero", "episode_steps")]
            scores = Reference(*values).scores(returns)
        summaries.append(
            SlotSummary(
                name=name,
                episodes=int(own.sum()),
                steps=int(steps.sum()),
                length=float(steps.mean()),
                returns=(returns.min(), float(np.median(returns)), returns.mean(), returns.max()),
                success=float(table["success"][own].mean()),
                score=None if scores is None else float(scores.mean()),
                tasks=len(np.unique(table["variation"][own], axis=0)),
                broken=int(table["broken"][own].sum()),
            )
        )
    return summaries


def coverage(dataset: Dataset) -> Json:
    """Measure how widely states and actions are spread over at most 2,000 episodes.

    Two results are per group of the observation: ``observation_std`` is the standard deviation over all states,
    averaged over the group's entries; ``constant`` is the share of the group's entries that never change.
    ``action_std`` is the standard deviation averaged over actions; ``action_at_bounds`` is the share of action entries
    at ±1.
    """
    d = dataset.observation_size
    a = dataset.action_size
    count = 0
    taken = 0
    sums = np.zeros(d + a)
    squares = np.zeros(d + a)
    low = np.full(d, np.inf)
    high = np.full(d, -np.inf)
    bounds = 0
    first = np.zeros(0)
    for _, episode in _spread_episodes(dataset, _MOST_COVERED):
        if not len(episode):
            continue
        values = np.concatenate([episode.observations[:-1], episode.actions], 1).astype(np.float64)
        if len(first) == 0:
            first = values[0].copy()
        values -= first  # sums of squares lose fewer digits
        sums = sums + values.sum(0)
        squares = squares + (values**2).sum(0)
        count = count + len(values)
        low = np.minimum(low, values[:, :d].min(0))
        high = np.maximum(high, values[:, :d].max(0))
        bounds = bounds + int((np.abs(episode.actions) >= 1.0).sum())
        taken = taken + episode.actions.size
    if not count:
        raise BidexError(f"{dataset.folder}: expected episodes with transitions, got empty ones. Record it again.")
    std = np.sqrt(np.maximum(squares / count - (sums / count) ** 2, 0.0))
    groups = dataset.metadata.get("observation_groups", [["state", [[0, d]]]])
    where = {name: np.concatenate([np.arange(*part) for part in parts]) for name, parts in groups}
    return {
        "observation_std": {name: float(std[:d][own].mean()) for name, own in where.items()},
        "constant": {name: float((low[own] == high[own]).mean()) for name, own in where.items()},
        "action_std": float(std[d:].mean()),
        "action_at_bounds": bounds / max(taken, 1),
    }

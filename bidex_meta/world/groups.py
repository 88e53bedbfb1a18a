"""Groups of environments whose models have equal structure and share one engine batch."""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import mujoco
import numpy as np
import torch
from msgspec import Meta
from torch import Tensor

from bidex_meta.engine.capacity import room_for
from bidex_meta.engine.models import same_structure
from bidex_meta.engine.protocol import Engine, EngineMaker
from bidex_meta.errors import BidexError
from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.scene import Scene, compile_scene
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.validation import BelowOne, Text
from bidex_meta.world.depth_sensor import DepthSensor, PointsRule

_LARGEST = 1e6
"""Largest absolute value in a variation (metres, radians, draws): squared distances stay finite in single precision."""


@checked_arguments
@dataclass(frozen=True)
class Slot:
    """A task class with a pool of tasks and a share of a world's environments."""

    name: Text
    """Name, e.g. ``CatchUnderarm`` or ``CatchUnderarm/left``."""
    task_class: TaskClass
    tasks: np.ndarray
    """Variations, shape (n, variation_space.size), float64."""
    reward_scale: Annotated[float, Meta(gt=0.0, le=1_000_000)] = 1.0
    gamma: BelowOne | None = None
    """Discount factor per step that learners must use for this slot; None means that learners use their own."""


@dataclass(frozen=True)
class Member:
    """The environments of one slot, as a part of the group of slots that share an engine.

    The environments are contiguous in the world (``env_ids``) and in the engine (``engine_rows``).
    """

    slot: int
    scene: Scene
    env_ids: slice
    engine_rows: slice


@dataclass(frozen=True)
class Group:
    """Slots whose models have the same structure, on one engine."""

    engine: Engine
    members: tuple[Member, ...]
    env_ids: Tensor
    """Index in the world of each simulation's environment, shape (num,), int64."""
    span: slice | None
    """The group's environments as a slice if they are contiguous, else None."""

    def take(self, values: Tensor) -> Tensor:
        """Return this group's part of a tensor over all environments (a view if they are contiguous)."""
        if self.span is not None:
            return values[self.span]
        return values[self.env_ids]


def with_pools(slots: list[Slot], pools: dict[str, np.ndarray]) -> list[Slot]:
    """Return the slots, with the task pools of the named slots replaced; see :func:`with_pool`.

    Raises BidexError for an unknown slot.
    """
    if not isinstance(pools, Mapping):
        raise BidexError(f"Expected tasks as a dict from slot to variations, got {type(pools).__name__}.")
    slots = list(slots)
    names = [slot.name for slot in slots]
    for name, tasks in pools.items():
        if name not in names:
            raise BidexError(f"Expected a slot among {', '.join(names)}, got {name!r}.")
        i = names.index(name)
        slots[i] = with_pool(slots[i], tasks)
    return slots


def with_pool(slot: Slot, tasks: np.ndarray) -> Slot:
    """Return the slot with its task pool replaced by a copy of the given one, shape (n, variation_space.size).

    Raises BidexError for a wrong shape, or numbers that are not finite.
    """
    space = slot.task_class.variation_space
    wanted = f"Expected tasks of {slot.name} with shape (n, {space.size})"
    try:
        given = np.asarray(tasks)
    except (TypeError, ValueError, RuntimeError):
        given = np.array(None)
    if given.dtype.kind not in "fiub":
        raise BidexError(f"{wanted}, got {type(tasks).__name__} that is no array of real numbers.")
    tasks = given.astype(np.float64)  # makes a copy
    if tasks.ndim != 2 or len(tasks) == 0 or tasks.shape[1] != space.size:
        raise BidexError(f"{wanted}, got {tasks.shape}.")
    good = np.abs(tasks) <= _LARGEST  # the comparison is false for NaN
    if not good.all():
        row, column = (int(i) for i in np.argwhere(~good)[0])
        raise BidexError(
            f"{wanted} and numbers within +-{_LARGEST:g}, got {space.names[column]} = {tasks[row, column]} "
            f"in row {row}."
        )
    return replace(slot, tasks=tasks)


def build_groups(slots: list[Slot], env_ids: list[slice], make_engine: EngineMaker) -> list[Group]:
    """Compile the slots' scenes, and group the slots that can share an engine.

    The models and observation layouts of a group have equal structure. Groups, and the slots within a group, keep the
    order of ``slots``. ``env_ids`` holds the contiguous environments of each slot.
    """
    scenes: dict[Hashable, Scene] = {}
    pools: list[list[int]] = []
    for slot in slots:
        if slot.task_class.scene_key not in scenes:
            scenes[slot.task_class.scene_key] = compile_scene(slot.task_class)
    by_slot = [scenes[slot.task_class.scene_key] for slot in slots]
    for i, scene in enumerate(by_slot):
        home = next((pool for pool in pools if _alike(by_slot[pool[0]], scene)), None)
        if home is None:
            pools.append(home := [])
        home.append(i)
    return [_build_group([(i, by_slot[i], env_ids[i]) for i in pool], make_engine) for pool in pools]


def sights(groups: list[Group], rule: PointsRule, first: int) -> list[DepthSensor]:
    """Return the depth sensor of each slot, in the order of the slots.

    A sensor writes its point cloud into the entries of an observation from ``first`` on.
    """
    by_scene: dict[int, DepthSensor] = {}
    by_slot: dict[int, DepthSensor] = {}
    for group in groups:
        for member in group.members:
            key = id(member.scene)
            if key not in by_scene:
                by_scene[key] = DepthSensor(member.scene, rule, first, group.engine.device)
            by_slot[member.slot] = by_scene[key]
    return [by_slot[slot] for slot in sorted(by_slot)]


def _alike(a: Scene, b: Scene) -> bool:
    """Return whether two scenes may share an engine and an observer."""
    return a.task.layout == b.task.layout and same_structure(a.model, b.model)


def _build_group(slots: list[tuple[int, Scene, slice]], make_engine: EngineMaker) -> Group:
    members: list[Member] = []
    model_of_row: list[int] = []
    models: list[mujoco.MjModel] = []
    start = 0
    for slot, scene, own in slots:
        count = own.stop - own.start
        members.append(Member(slot, scene, own, slice(start, start + count)))
        if scene.model not in models:
            models.append(scene.model)
        model_of_row += [models.index(scene.model)] * count
        start += count
    env_ids = torch.cat([torch.arange(m.env_ids.start, m.env_ids.stop) for m in members])
    first = int(env_ids[0])
    last = int(env_ids[-1])
    if last - first + 1 == len(env_ids):
        span = slice(first, last + 1)
    else:
        span = None
    engine = make_engine(models, model_of_row, room_for([scene.task.needs for _, scene, _ in slots]))
    return Group(engine, tuple(members), env_ids.to(engine.device), span)

"""The computation of observations from sensors, and the named groups of observation entries.

All entries are gathered in one operation and scaled in another. The task classes then fill in the blocks of the goal.
"""

from collections.abc import Sequence
from itertools import groupby
from typing import Literal

import torch
from torch import Tensor

from bidex_meta.hands.hand import SIDES, hand
from bidex_meta.tasks.layout import GOAL_QUATERNIONS, Layout, both_hands
from bidex_meta.tasks.scene import Scene
from bidex_meta.utils.maths import conjugate, xyzw
from bidex_meta.world.contract import ObservationGroup

Rule = Literal["plain", "one-hot", "masked"]
"""Contents of a suite's observations: all entries, all entries and the task id, or all entries with the goal zeroed."""
_HAND_OF = {block.name: f"{block.name.partition('_')[0]}_hand" for block in both_hands(moving=True, touch=True)}
"""Observation group of each block of a hand, by the block's name. The prefix ``right_`` alone does not identify a hand:
``right_handle_position`` belongs to an object."""


class Observer:
    """Builds the observations of environments that have the same observation layout.

    All entries are gathered from sensors, last actions and base rotations. Blocks that only a task class can compute
    (such as the goal's pose) are left at zero, and ``Part`` fills them in. Padding stays at zero, and so does a goal
    that the suite masks.
    """

    def __init__(self, scene: Scene, start_mounts: Tensor, width: int) -> None:
        """Look up the source, scale and offset of every observation entry.

        ``scene`` may be any scene whose task has the layout. ``start_mounts`` (num, 2, 4) holds the orientations
        (x, y, z, w) of both hands' mounts at the start, for each row of the engine. ``width`` is the number of
        observation entries, including padding and task id.
        """
        self.layout: Layout = scene.task.layout
        device = start_mounts.device
        sensors = scene.model.nsensordata
        actions = sensors + scene.task.action_size
        if scene.task.moving_base:
            turns = 3 * len(SIDES)
        else:
            turns = 0
        # These hold sensors, actions and rotations. Allocating them in every step would cost more than filling them.
        self._values = torch.empty(len(start_mounts), actions + turns, device=device)
        self._columns = slice(0, sensors), slice(sensors, actions), slice(actions, actions + turns)
        self._source = torch.zeros(width, dtype=torch.int64, device=device)
        self._scale, self._offset = torch.zeros(2, width, device=device).unbind()
        self._saturating = [where for block, where in self.layout if block.saturates]
        span = torch.as_tensor(hand().high - hand().low).float().to(device)
        middle = torch.as_tensor(hand().high + hand().low).float().to(device)
        for block, where in self.layout:
            if block.sensors:
                self._source[where] = torch.cat([_indices(scene, name) for name in block.sensors]).to(device)
                self._scale[where] = block.scale
            if block.name.endswith("joint_position"):
                self._scale[where] = 2.0 / span
                self._offset[where] = -middle / span
        share = scene.task.action_size // len(SIDES)
        for i, side in enumerate(SIDES):
            self._take(f"{side}_action", sensors + i * share)
            if turns:
                self._take(f"{side}_base_rotation", actions + 3 * i)
        self._start_inverse = conjugate(start_mounts)
        self._mounts = torch.cat([_indices(scene, f"{side}/mount_quaternion") for side in SIDES]).to(device)
        self.moving = turns > 0
        self._quaternions = torch.tensor(self._of_quaternions(scene), device=device)

    def _take(self, block: str, first: int) -> None:
        where = self.layout.range(block)
        self._source[where] = torch.arange(first, first + where.stop - where.start)
        self._scale[where] = 1.0

    def _of_quaternions(self, scene: Scene) -> list[int]:
        """Return the first observation entry of each quaternion whose sign ``choose_signs`` sets.

        The list is empty unless the class has version 2's wide variation. A goal's block ends with such a quaternion.
        Quaternions of hands are left out: joints turn a hand continuously from one start, so that the sign is unique
        even if w is near 0.
        """
        if not scene.task.rules.wide:
            return []
        found = []
        for block, where in self.layout:
            if block.name in _HAND_OF:
                continue
            if block.goal and block.name.endswith(GOAL_QUATERNIONS):
                found += [where.stop - 4]
            at = where.start
            for name in block.sensors:
                found += [at] if name.endswith("quaternion") else []
                at += len(_indices(scene, name))
        return found

    def choose_signs(self, values: Tensor) -> None:
        """Negate each quaternion of an object or goal whose w is negative, in observations (n, width), in place.

        Only classes with version 2's wide variation do this; for other classes nothing changes.
        """
        if len(self._quaternions):
            columns = (self._quaternions[:, None] + torch.arange(4, device=values.device)).flatten()
            turns = values[:, columns].unflatten(1, (-1, 4))
            values[:, columns] = torch.where(turns[..., 3:] < 0.0, -turns, turns).flatten(1)

    def mounts(self, sensors: Tensor, rows: Tensor | slice) -> tuple[Tensor, Tensor]:
        """Return the orientations of both hands' mounts, and the inverses of their start orientations.

        Both results (n, 2, 4) hold quaternions (x, y, z, w) for the engine rows ``rows``.
        """
        return sensors.index_select(1, self._mounts).view(-1, len(SIDES), 4), self._start_inverse[rows]

    def __call__(self, sensors: Tensor, action: Tensor, rotation: Tensor | None, out: Tensor | None = None) -> Tensor:
        """Return observations (n, width), float32, before clipping and without the blocks that task classes compute.

        They are computed from sensors (n, nsensordata), last actions (n, a) and base rotations (n, 2, 3), which are
        None for fixed bases. If ``out`` is given, the result is written into it.
        """
        values = self._values[: len(sensors)]
        sensed, acted, turned = self._columns
        values[:, sensed] = sensors
        values[:, acted] = action
        if rotation is not None:
            values[:, turned] = rotation.flatten(1)
        shown = torch.index_select(values, 1, self._source, out=out).mul_(self._scale).add_(self._offset)
        for where in self._saturating:
            block = shown[:, where]
            block.div_(1.0 + block.abs())
        return shown


def _indices(scene: Scene, name: str) -> Tensor:
    """Return the indices of a sensor in ``sensordata``; those of a quaternion are in the order (x, y, z, w)."""
    where = scene.sensors[name]
    indices = torch.arange(int(where.start), int(where.stop))
    if name.endswith("quaternion"):
        return xyzw(indices)
    return indices


def observation_groups(
    layouts: Sequence[Layout],
    width: int,
    num_id_columns: int,
    hidden: Sequence[Sequence[int]] | None = None,
    points: tuple[str, int] | None = None,
) -> tuple[ObservationGroup, ...]:
    """Return observation groups that are valid for all classes of a world.

    Entries whose kind differs by class form the group ``task``. ``width``: number of entries of the padded observation,
    without cloud and task id. ``hidden``: for each layout, the entries that are always zero and count as padding.
    ``points``: name and number of entries of the cloud, which lies between the padded observation and the task id.
    """
    if hidden is None:
        hidden = [()] * len(layouts)
    by_class = zip(*(_kinds(layout, width, zero) for layout, zero in zip(layouts, hidden, strict=True)), strict=True)
    kinds = [kinds[0] if len(set(kinds)) == 1 else "task" for kinds in by_class]
    if points is not None:
        kinds += [points[0]] * points[1]
    kinds += ["task_id"] * num_id_columns
    ranges: dict[str, list[slice]] = {}
    for kind, run in groupby(range(len(kinds)), key=kinds.__getitem__):
        entries = list(run)
        ranges.setdefault(kind, []).append(slice(entries[0], entries[-1] + 1))
    return tuple(ObservationGroup(kind, tuple(where)) for kind, where in ranges.items())


def _kinds(layout: Layout, width: int, hidden: Sequence[int]) -> list[str]:
    kinds = ["padding"] * width
    for block, where in layout:
        kinds[where] = [_HAND_OF.get(block.name, "goal" if block.goal else "object")] * block.size
    for i in hidden:
        kinds[i] = "padding"
    return kinds

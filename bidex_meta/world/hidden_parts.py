"""What a suite that hides goals does not show: to teachers, and to learners that are asked for it in training."""

from functools import cached_property

import torch
from torch import Tensor

from bidex_meta.errors import BidexError, shortened
from bidex_meta.tasks.state import TaskState
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.world.part import judge
from bidex_meta.world.world import World


class HiddenParts:
    """The hidden parts of the tasks that a world plays: numbers of a variation (``TaskClass.hides``), in [-1, 1]."""

    @checked_arguments
    def __init__(self, world: World) -> None:
        self._world = world

    @cached_property
    def columns(self) -> Tensor:
        """Entries of observations that are hidden, those of goals: ascending, int64 (k,)."""
        each = {i for slot in self._world.slots for i in slot.task_class.layout.goal_indices()}
        return torch.tensor(sorted(each), dtype=torch.int64, device=self._world.device)

    def entries(self) -> Tensor:
        """What these entries would be now: (N, k), zeros where a class has no such entry."""
        world = self._world
        values = torch.empty(world.num_envs, world.observation_size, device=world.device)
        for part in world.parts:
            values[part.group.rows] = part.goals(part.group.take(world.task_index), world.observation_size)
        return values[:, self.columns]

    @cached_property
    def variations(self) -> dict[str, list[int]]:
        """Of each slot: the columns of its tasks that are hidden."""
        return {slot.name: slot.task_class.hidden_columns() for slot in self._world.slots}

    def values(self) -> Tensor:
        """What the task of each environment hides, scaled from its range: (N, n), zeros behind."""
        world = self._world
        values = torch.zeros(world.num_envs, world.hidden_size, device=world.device)
        for slot, rows in zip(world.slots, world.slot_rows, strict=True):
            columns, (middle, half) = self.variations[slot.name], self._ranges[slot.name]
            scaled = (torch.as_tensor(slot.tasks[:, columns]).to(world.device) - middle) / half
            values[rows, : len(columns)] = scaled.float()[world.task_index[rows]]
        return values

    def rewards(self, values: Tensor) -> Tensor:
        """What the step just made would have paid had the tasks hidden other values (..., N, n): (..., N)."""
        world = self._world
        shape = (world.num_envs, world.hidden_size)
        if not isinstance(values, Tensor) or values.shape[-2:] != shape:
            got = tuple(values.shape) if isinstance(values, Tensor) else shortened(values)
            raise BidexError(f"HiddenParts.rewards: expected values of shape (..., {shape[0]}, {shape[1]}), got {got}.")
        given = values.reshape(-1, *shape)
        rewards = torch.zeros(given.shape[:2], device=world.device)
        for part in world.parts:
            sensors = part.group.engine.sensordata
            for member in part.group.members:
                slot, rows = world.slots[member.slot], member.world_rows
                columns, (middle, half) = self.variations[slot.name], self._ranges[slot.name]
                tasks = torch.as_tensor(slot.tasks).to(sensors)[world.task_index[rows]].repeat(len(given), 1)
                hidden = given[:, rows, : len(columns)].flatten(0, 1)
                tasks[:, columns] = hidden.to(sensors) * half.to(sensors) + middle.to(sensors)
                task, felt = member.scene.task, sensors[member.engine_rows].repeat(len(given), 1)
                state = TaskState(felt, member.scene.sensors, task.freeze(tasks))
                paid = judge(task, state).reward * slot.reward_scale
                rewards[:, rows] = paid.float().unflatten(0, (len(given), -1))
        return rewards.view(values.shape[:-1])

    @cached_property
    def _ranges(self) -> dict[str, tuple[Tensor, Tensor]]:
        """Of each slot: middle and half width of its hidden values, (n,) each, float64."""
        found = {}
        for slot in self._world.slots:
            space, columns = slot.task_class.variation_space, self.variations[slot.name]
            ends = (
                torch.tensor(end, dtype=torch.float64, device=self._world.device) for end in (space.low, space.high)
            )
            low, high = (end[columns] for end in ends)
            found[slot.name] = 0.5 * (high + low), 0.5 * (high - low)
        return found

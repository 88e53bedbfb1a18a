"""Access to the numbers of tasks that observations hide, for worlds with hands (``contract.PrivilegedWorld``)."""

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from bidex_meta.errors import BidexError, shortened
from bidex_meta.tasks.state import TaskState
from bidex_meta.utils.maths import indices
from bidex_meta.world.groups import Member, Slot
from bidex_meta.world.part import Part, PartedWorld, judgement_of


class HiddenParts:
    """Gives access to the numbers of tasks that classes hide (``TaskClass.hides``).

    Each number is scaled from its range to [-1, 1].
    """

    def __init__(self, slots: Sequence[Slot], device: torch.device) -> None:
        self.columns: dict[str, list[int]] = {}
        """Hidden columns of each slot's tasks."""
        self._ranges: dict[str, tuple[Tensor, Tensor]] = {}
        """Middle and half width of the range of each hidden value, by slot, (n,) each, float64."""
        goal_indices = set[int]()
        for slot in slots:
            columns = slot.task_class.hidden_columns()
            space = slot.task_class.variation_space
            low = torch.tensor(space.low, dtype=torch.float64, device=device)[columns]
            high = torch.tensor(space.high, dtype=torch.float64, device=device)[columns]
            self.columns[slot.name] = columns
            self._ranges[slot.name] = 0.5 * (high + low), 0.5 * (high - low)
            goal_indices.update(slot.task_class.layout.goal_indices())
        self.entries = torch.tensor(sorted(goal_indices), dtype=torch.int64, device=device)
        """Entries of an observation that would show the goal."""
        self.size = max(map(len, self.columns.values()))
        """Maximum number of values that the tasks of a class hide."""

    def with_goals(self, world: PartedWorld, obs: Tensor, goals: Tensor | None = None) -> Tensor:
        """See ``PrivilegedWorld.with_goals``."""
        if goals is None:
            own = [list(part.states(part.group.take(world.task_index))) for part in world.parts]
            return self._shown(world, obs, own)
        seen = []
        for each in self._checked("with_goals", world, goals):
            states = []
            for part in world.parts:
                found = self._states(world, part, each[None])
                states.append([(member, member.engine_rows, state) for member, state in found])
            seen.append(self._shown(world, obs, states))
        return torch.stack(seen).view(*goals.shape[:-1], obs.shape[1])

    def _shown(self, world: PartedWorld, obs: Tensor, states: list[list[tuple[Member, slice, TaskState]]]) -> Tensor:
        """Return the observations (N, d) with the goals of the given states of each part."""
        values = torch.empty(world.num_envs, world.observation_size, device=world.device)
        for part, own in zip(world.parts, states, strict=True):
            values[part.group.env_ids] = part.goals(own, world.observation_size)
        # The parts are added, because an entry of the goal in one class may belong to an object in another class.
        return obs.index_add(1, self.entries, values[:, self.entries])

    def _states(self, world: PartedWorld, part: Part, given: Tensor) -> Iterator[tuple[Member, TaskState]]:
        """Yield the present state of each member of a part, as if its tasks had other hidden values (g, N, n).

        The rows of a state are those of the first of the g goals, then those of the second, and so on.
        """
        sensors = part.group.engine.sensordata
        for member, pool in zip(part.group.members, part.tasks, strict=True):
            slot = world.slots[member.slot]
            columns = self.columns[slot.name]
            middle, half = self._ranges[slot.name]
            tasks = pool.to(sensors)[world.task_index[member.env_ids]].repeat(len(given), 1)
            hidden = given[:, member.env_ids, : len(columns)].flatten(0, 1)
            tasks[:, indices(columns, tasks)] = hidden.to(sensors) * half.to(sensors) + middle.to(sensors)
            sensed = sensors[member.engine_rows].repeat(len(given), 1)
            yield member, TaskState(sensed, member.scene.sensors, member.scene.task.frozen(tasks))

    def values(self, world: PartedWorld) -> Tensor:
        """See ``PrivilegedWorld.hidden_values``."""
        values = torch.zeros(world.num_envs, world.hidden_size, device=world.device)
        for part in world.parts:
            for member, tasks in zip(part.group.members, part.tasks, strict=True):
                slot = world.slots[member.slot]
                columns = self.columns[slot.name]
                middle, half = self._ranges[slot.name]
                scaled = (tasks[:, indices(columns, tasks)] - middle) / half
                values[member.env_ids, : len(columns)] = scaled.float()[world.task_index[member.env_ids]]
        return values

    def rewards(self, world: PartedWorld, goals: Tensor) -> Tensor:
        """See ``PrivilegedWorld.rewards_if``."""
        given = self._checked("rewards_if", world, goals)
        rewards = torch.zeros(given.shape[:2], device=world.device)
        for part in world.parts:
            for member, state in self._states(world, part, given):
                paid = judgement_of(member.scene.task, state).reward * world.slots[member.slot].reward_scale
                rewards[:, member.env_ids] = paid.float().unflatten(0, (len(given), -1))
        return rewards.view(goals.shape[:-1])

    def _checked(self, name: str, world: PartedWorld, goals: object) -> Tensor:
        """Return hidden values (..., N, n) with one leading axis; raise BidexError for another shape."""
        shape = (world.num_envs, world.hidden_size)
        if isinstance(goals, Tensor) and goals.shape[-2:] == shape:
            return goals.reshape(-1, *shape)
        if isinstance(goals, Tensor):
            got = tuple(goals.shape)
        else:
            got = shortened(goals)
        raise BidexError(f"World.{name}: expected goals of shape (..., {shape[0]}, {shape[1]}), got {got}.")

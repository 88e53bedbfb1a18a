"""The environments that one engine simulates: controls, starts, observations, rewards."""

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import chain
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from bidex_meta.rules import CONTROL_RATE
from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.layout import CLIP
from bidex_meta.tasks.state import TaskState
from bidex_meta.utils.maths import multiply, roll_pitch_yaw, xyzw
from bidex_meta.world.base import Transition
from bidex_meta.world.controls import Controls
from bidex_meta.world.depth_sensor import DepthSensor
from bidex_meta.world.formulas import check_formulas, check_numbers
from bidex_meta.world.graphs import Together
from bidex_meta.world.groups import Group, Member, Slot
from bidex_meta.world.observations import Observer, Rule


class Part:
    """A group of environments, with all that turns actions into engine inputs and engine states into transitions."""

    def __init__(
        self,
        group: Group,
        slots: list[Slot],
        rule: Rule,
        width: int,
        num_envs: int,
        sights: list[DepthSensor] | None = None,
    ) -> None:
        """Allocate the tensors of the part.

        ``slots``, ``rule``, ``width`` (with padding and task id) and ``num_envs`` are those of the world. ``sights``
        holds the depth sensor of each slot, or is None if observations show the objects' states.
        """
        self.group = group
        self._engine = group.engine
        self._rule = rule
        self._sights = sights
        self.engine_rows = torch.full((num_envs,), -1, device=self._engine.device)
        """Engine row of each environment of the world, or -1 for environments of other parts, shape (num_envs,)."""
        self.engine_rows[group.env_ids] = torch.arange(self._engine.num, device=self._engine.device)
        self.substeps = round(1.0 / (CONTROL_RATE * group.members[0].scene.model.opt.timestep))
        """Engine steps per control step."""
        self.checks_numbers = self._engine.device.type == "cpu"
        """True if every step checks the numbers of the user's own classes; on a GPU that would stall the step."""
        self._controls = Controls(group)
        self._start = torch.stack([torch.from_numpy(m.scene.start_qpos) for m in group.members]).to(self._engine.qpos)
        self.start_size = self._start.shape[1]
        """Size of a start position, which consists of ``qpos`` and the poses of movable fixtures."""
        for member in group.members:
            tasks = slots[member.slot].tasks
            check_formulas(member.scene, tasks, self._engine.sensordata)
        self._goals = {m.slot: {b.name for b, _ in m.scene.task.layout if b.goal} for m in group.members}
        self._observer = Observer(group.members[0].scene, self._start_mounts(), width)
        if sights is not None:
            self._engine.body_poses()  # from this call on, the engine computes the poses
        self.set_pools(slots)

    def _start_mounts(self) -> Tensor:
        mounts = self._engine.sensordata.new_empty(self._engine.num, 2, 4)
        for member in self.group.members:
            task = member.scene.task
            mounts[member.engine_rows] = xyzw(mounts.new_tensor([task.right.quaternion, task.left.quaternion]))
        return mounts

    def set_pools(self, slots: list[Slot]) -> None:
        """Replace the task pools by those of the slots."""
        self.tasks = list[Tensor]()
        """Pool of each member, (n, size of its variations), float64."""
        self._pools = list[dict[str, Tensor]]()
        for member in self.group.members:
            tasks = torch.tensor(slots[member.slot].tasks, device=self._engine.device)
            frozen = member.scene.task.frozen(tasks.to(self._engine.sensordata))
            self.tasks.append(tasks)
            # The values are copied, because some are views of others and ``renew`` writes into them.
            pool = {}
            for name, value in frozen.items():
                pool[name] = value.clone(memory_format=torch.contiguous_format)
            self._pools.append(pool)

    def renew(self, mask: Tensor, shares: Tensor) -> None:
        """Give new tasks to the environments of a mask (num,).

        Environment j of a slot plays entry j of its slot's pool. ``shares`` (num, k), in [0, 1), give the tasks'
        positions in the ranges of their variation spaces; k is at least the size of the largest space. Entire pools are
        rewritten in place, although only the entries in the mask change, because recorded graphs read the pools and
        have fixed shapes.
        """
        for member, tasks, pool in zip(self.group.members, self.tasks, self._pools, strict=True):
            task = member.scene.task
            rows = member.engine_rows
            tasks.copy_(torch.where(mask[rows, None], task.varied(shares[rows]), tasks))
            for name, values in task.frozen(tasks.to(self._engine.sensordata)).items():
                pool[name].copy_(values)

    def frozen(self, member: int, task_index: Tensor) -> dict[str, Tensor]:
        """Return the values that a task class computes once per task (``TaskClass.freeze``), for some tasks.

        ``member``: index of the class in the group. ``task_index``: indices of the tasks in the class's pool.
        """
        return {name: values[task_index] for name, values in self._pools[member].items()}

    def control(self, action: Tensor) -> None:
        """Write the actions of the part's environments, shape (num, a), into the engine."""
        self._controls.write(action)

    def step(self, action: Tensor, active: Tensor | None) -> None:
        """Apply actions, shape (num, a), and advance all environments, or those of the mask, by a control step."""
        self.control(action)
        self.advance(active)

    def advance(self, active: Tensor | None) -> None:
        """Advance all environments, or those of the mask, by one control step."""
        self._engine.step(self.substeps, active)

    def unstable(self) -> Tensor:
        """Return which environments broke since their last reset, shape (num,), bool."""
        return self._engine.unstable()

    def states(self, task_index: Tensor, rows: Tensor | None = None) -> Iterator[tuple[Member, slice, TaskState]]:
        """Yield the state of each member (a class of the group) that has rows among the chosen rows of the engine.

        Yields the member, the slice of its rows among the chosen rows, and its state. ``task_index`` (num,): task of
        each environment of the part. ``rows``: chosen engine rows, ascending; None: all.
        """
        for i, member, where, chosen in self.members(rows):
            frozen = self.frozen(i, task_index[chosen])
            yield member, where, TaskState(self._engine.sensordata[chosen], member.scene.sensors, frozen)

    def members(self, rows: Tensor | None) -> Iterator[tuple[int, Member, slice, Tensor | slice]]:
        """Yield index, member, slice and engine rows of each member that has chosen rows.

        A member is a class of the group. The slice is the place of its rows among the chosen rows (None: all).
        """
        for i, member in enumerate(self.group.members):
            if rows is None:
                yield i, member, member.engine_rows, member.engine_rows
                continue
            bounds = rows.new_tensor((member.engine_rows.start, member.engine_rows.stop))
            first, last = torch.searchsorted(rows, bounds).tolist()
            if last > first:
                yield i, member, slice(first, last), rows[first:last]

    def rows_in(self, mask: Tensor) -> Tensor | None:
        """Return the engine rows of the environments of a mask (num_envs,), ascending; None stands for all rows.

        Engines for accelerators (``Engine.avoids_syncs``) always get None, because counting the entries of a mask would
        make the host wait for the accelerator.
        """
        if self._engine.avoids_syncs:
            return None
        return self.group.take(mask).nonzero().squeeze(1)

    def mounts(self, rows: Tensor | None) -> tuple[Tensor, Tensor] | None:
        """Return the orientations of the hands' mounts (``Observer.mounts``), or None if the bases are fixed.

        ``rows`` chooses rows of the engine; None chooses all.
        """
        chosen = slice(None) if rows is None else rows
        if self._observer.moving:
            return self._observer.mounts(self._engine.sensordata[chosen], chosen)
        return None

    def observe(
        self,
        states: list[tuple[Member, slice, TaskState]],
        action: Tensor,
        rotation: Tensor | None,
        rows: Tensor | None = None,
        out: Tensor | None = None,
    ) -> Tensor:
        """Return the observations of engine rows without the task id, shape (n, width), float32.

        ``rows`` are ascending; None stands for all rows. ``states`` and ``rotation`` are the results of ``states()``
        and ``base_rotations`` for these rows, and ``action`` (n, a) holds their last actions. If ``out`` (n, width) is
        given, the result is written into it.
        """
        sensors = self._engine.sensordata
        values = self._observer(sensors if rows is None else sensors[rows], action, rotation, out)
        self._show_computed(values, states, rows, self._rule != "masked")
        self._observer.choose_signs(values)
        if self._sights is not None:
            body_positions, body_rotations = self._engine.body_poses()
            for member, where, _ in states:
                if rows is None:
                    own = member.engine_rows
                else:
                    own = rows[where]
                self._sights[member.slot].show(values[where], body_positions[own], body_rotations[own])
        return values.clamp_(-CLIP, CLIP)

    def _show_computed(
        self,
        values: Tensor,
        states: list[tuple[Member, slice, TaskState]],
        rows: Tensor | None = None,
        goals: bool = True,
    ) -> None:
        """Write the blocks that classes compute; without ``goals`` only those that show no goal.

        The blocks that our own classes compute all show goals.
        """
        for member, where, state in states:
            task = member.scene.task
            if not goals and task.is_shipped:
                continue
            blocks = task.observe(state)
            if not goals:
                blocks = {name: block for name, block in blocks.items() if name not in self._goals[member.slot]}
            if self.checks_numbers:
                if rows is None:
                    engine_rows = member.engine_rows
                else:
                    engine_rows = rows[where]
                check_numbers(member.scene.task, "observe", blocks, self.unstable, engine_rows)
            for name, block in blocks.items():
                values[where, self._observer.layout.range(name)] = block.float()

    def goals(self, states: list[tuple[Member, slice, TaskState]], width: int) -> Tensor:
        """Return observations (num, width) with the goals, as if nothing were hidden; all other entries are zero.

        ``states`` are those of all engine rows, with the goals to show.
        """
        values = torch.zeros(self._engine.num, width, device=self._engine.device)
        self._show_computed(values, states)
        self._observer.choose_signs(values)
        return values.clamp_(-CLIP, CLIP)

    def check_formulas(self, task_index: Tensor) -> None:
        """Raise BidexError if a user's own class returns numbers that are not finite in the present state."""
        for member, _, state in self.states(task_index):
            task = member.scene.task
            check_numbers(task, "reward_terms", task.rewards(state), self.unstable, member.engine_rows)
            check_numbers(task, "observe", task.observe(state), self.unstable, member.engine_rows)

    def starts(self, rows: Tensor | None, draws: Tensor, task_index: Tensor, shares: Tensor | None = None) -> Tensor:
        """Return start positions of episodes, (n, start_size), as a pure function of the draws and the tasks.

        Args:
            rows: Engine rows (n,), ascending. None: all rows, with n / num successive starts for each row.
            draws: Uniform numbers (n, k) in [-1, 1]; k is at least the number of draws that each class takes.
            task_index: Task of each start in its pool, (n,).
            shares: Positions of new tasks in their variation spaces, as in ``renew``. None: tasks come from the pools.
        """
        qpos = self._engine.qpos.new_empty(len(draws), self.start_size)
        if rows is None:
            each = len(draws) // self._engine.num
        else:
            each = 1
        for i, member, place, _ in self.members(rows):
            where = slice(each * place.start, each * place.stop)
            qpos[where] = self._start[i]
            views = {name: qpos[where, columns] for name, columns in member.scene.qpos.items()}
            task = member.scene.task
            own = draws[where, : task.draws]
            if shares is not None:
                frozen = task.frozen(task.varied(shares[where]).to(qpos), own)
            elif task.episode_space.size:
                frozen = task.frozen(self.tasks[i][task_index[where]].to(qpos), own)
            else:
                frozen = self.frozen(i, task_index[where])
            task.begin(own, frozen, views)
            if self.checks_numbers:
                check_numbers(task, "start", views)
        return qpos


class PartedWorld(Protocol):
    """The attributes of a world of hands (``World``) that pictures and hidden goals need."""

    num_envs: int
    device: torch.device
    slots: list[Slot]
    slot_env_ids: list[slice]
    parts: list[Part]
    task_id: Tensor
    task_index: Tensor
    observation_size: int
    hides_goals: bool
    """True if observations have zeros in place of goals."""

    @property
    def hidden_size(self) -> int:
        """See ``PrivilegedWorld``."""
        ...


def base_rotations(parts: Sequence[Part], rows: Sequence[Tensor | None] | None = None) -> Sequence[Tensor | None]:
    """Return, for each part, roll, pitch and yaw (n, 2, 3) of both bases relative to the start.

    ``rows`` holds the engine rows of each part; None stands for all rows. All parts are computed at once, because a
    dozen operations take as long on a few rows as on all.
    """
    if rows is None:
        rows = [None] * len(parts)
    mounts = [part.mounts(chosen) for part, chosen in zip(parts, rows, strict=True)]
    moving = [pair for pair in mounts if pair is not None]
    if not moving:
        return [None] * len(parts)
    now = torch.cat([orientation for orientation, _ in moving])
    start_inverse = torch.cat([inverse for _, inverse in moving])
    turned = roll_pitch_yaw(multiply(now, start_inverse))
    of_moving = iter(turned.split([len(orientation) for orientation, _ in moving]))
    rotations: list[Tensor | None] = []
    for pair in mounts:
        if pair is None:
            rotations.append(None)
        else:
            rotations.append(next(of_moving))
    return rotations


class Judgement(NamedTuple):
    """Reward terms, reward, success and failure that one task class computes for a step; see ``Transition``."""

    terms: dict[str, Tensor]
    reward: Tensor
    success: Tensor
    failed: Tensor


def judgement_of(task: TaskClass, state: TaskState) -> Judgement:
    """Return reward, success and failure of the step just made."""
    terms = task.rewards(state)
    values = list(terms.values())
    if len(values) > 1:
        reward = torch.stack(values).sum(dim=0)
    else:
        reward = values[0]
    return Judgement(terms, reward, task.solved_in(state), task.failed(state))


def read_transition(
    parts: Sequence[Part], task_index: Tensor, action: Tensor, width: int, together: Together
) -> Transition:
    """Compute rewards, success, failure and observations of all environments after a step.

    ``together`` runs one job per part. ``task_index`` (n,) and ``action`` (n, a) are those of the step. ``width`` is
    the number of observation entries; the entries of the task id are not written.
    """
    n = len(action)
    device = action.device
    reward = torch.empty(n, device=device)
    obs = torch.empty(n, width, device=device)
    success, failed, unstable = torch.zeros(3, n, dtype=torch.bool, device=device).unbind()
    found: list[tuple[slice, dict[str, Tensor]]] = []

    def look(part: Part, rotation: Tensor | None) -> None:
        group = part.group
        states = list(part.states(group.take(task_index)))
        if group.span is None:
            out = None
        else:
            out = obs[group.span]
        values = part.observe(states, group.take(action), rotation, out=out)
        broke = part.unstable()
        for member, where, state in states:
            env_ids = member.env_ids
            judged = judgement_of(member.scene.task, state)
            if part.checks_numbers:
                check_numbers(member.scene.task, "reward_terms", judged.terms, part.unstable, member.engine_rows)
            reward[env_ids] = judged.reward
            success[env_ids] = judged.success
            failed[env_ids] = judged.failed
            unstable[env_ids] = broke[where]
            found.append((env_ids, judged.terms))
            if out is None:
                obs[env_ids] = values[where]

    rotations = base_rotations(parts)
    together([partial(look, part, rotation) for part, rotation in zip(parts, rotations, strict=True)])
    names = list(dict.fromkeys(chain.from_iterable(own for _, own in found)))
    terms = dict(zip(names, torch.zeros(len(names), n, device=device), strict=True))
    for env_ids, own in found:
        for name, value in own.items():
            terms[name][env_ids] = value
    return Transition(obs, reward, success, failed, unstable, terms)

"""Agents that play recorded actions (witnesses) or scripts, and a world that starts near the start of a witness.

Demonstrations are recorded with these agents, and in this world.
"""

from collections.abc import Collection, Mapping, Sequence

import torch
from torch import Tensor

from bidex_meta.errors import BidexError
from bidex_meta.witness.controller import Actions, HandActions, HandController
from bidex_meta.witness.replay import SEED, task_slot
from bidex_meta.witness.scripts import script_of
from bidex_meta.witness.store import Witness
from bidex_meta.world import World, WorldConfig
from bidex_meta.world.contract import Info, Options
from bidex_meta.world.groups import Member
from bidex_meta.world.part import Part, base_rotations
from bidex_meta.world.wrapper import PooledWorldWrapper


class OpenLoopReplay:
    """An agent that plays the witness (recorded actions) of each environment's class and ignores observations.

    In classes without a witness all actions are zero. ``task_names`` are the classes of the world's slots, and
    ``task_id`` is the slot of each environment. ``actions`` is the size of the world's actions; a witness with smaller
    actions is padded with zeros. ``noise`` is the standard deviation of noise that is added to the actions.
    """

    def __init__(
        self, witnesses: Mapping[str, Witness], task_names: Sequence[str], task_id: Tensor, actions: int,
        noise: float = 0.0, seed: int = 0
    ):  # fmt: skip
        longest = max((len(witness.actions) for witness in witnesses.values()), default=1)
        self._sequences = torch.zeros(len(task_names), longest, actions, device=task_id.device)
        for slot, name in enumerate(task_names):
            if name in witnesses:
                recorded = torch.from_numpy(witnesses[name].actions)
                steps = torch.arange(longest).clamp_max(len(recorded) - 1)  # the last action is repeated
                self._sequences[slot, :, : recorded.shape[1]] = recorded[steps]
        self._task_id = task_id
        self._step = torch.zeros_like(task_id)
        self._noise = noise
        self._generator = torch.Generator(task_id.device).manual_seed(seed)

    def eval_action(self, obs: Tensor) -> Tensor:
        """Return the next actions (num_envs, action)."""
        action = self._sequences[self._task_id, self._step.clamp_max(self._sequences.shape[1] - 1)]
        self._step += 1
        if self._noise:
            noise = torch.randn(action.shape, generator=self._generator, device=action.device)
            action = (action + self._noise * noise).clamp(-1.0, 1.0)
        return action

    def reset(self, env_mask: Tensor) -> None:
        """Begin the recorded actions again in the environments that ``env_mask`` (num_envs,) selects."""
        self._step[env_mask] = 0


class Scripted:
    """An agent that plays the scripted policies of a world's classes.

    A script begins when an episode of its environment begins. It reads the present state in every step, and therefore
    corrects for ``noise`` on the actions (a standard deviation), or for actions of another policy. When a script has
    ended, its last action is repeated. ``world`` must run on C MuJoCo and have moving bases. ``names`` are the slots in
    which scripts play (None: all slots); other slots get zero actions. With ``misled`` each script is given the next
    task of the pool instead of its own task, as if it had to guess the goal. Raises BidexError for a class without a
    script.
    """

    def __init__(
        self, world: World, noise: float = 0.0, seed: int = 0, names: Collection[str] | None = None,
        misled: bool = False
    ):  # fmt: skip
        self._world = world
        self._noise = noise
        self._generator = torch.Generator().manual_seed(seed)
        if names is None:
            names = world.task_names
        self._classes: list[_Class] = []
        for part in world.parts:
            for number, member in enumerate(part.group.members):
                if world.slots[member.slot].name in names:
                    self._classes.append(_Class(world, part, number, member, int(misled)))
        self._actions = torch.zeros(world.num_envs, world.action_size)

    def eval_action(self, obs: Tensor) -> Tensor:
        """Return the next actions (num_envs, action)."""
        for each in self._classes:
            each.write(self._actions)
        if not self._noise:
            return self._actions.clone()
        noise = torch.randn(self._actions.shape, generator=self._generator)
        return (self._actions + self._noise * noise).clamp(-1.0, 1.0)

    def reset(self, env_mask: Tensor) -> None:
        """Begin new scripts in the environments that ``env_mask`` (num_envs,) selects.

        These environments must be at the start of an episode.
        """
        for each in self._classes:
            each.begin(env_mask)


class _Class:
    """The scripts of a class's environments, whose actions are computed together."""

    def __init__(self, world: World, part: Part, number: int, member: Member, ahead: int):
        task = world.slots[member.slot].task_class
        self._ahead = ahead
        self._world = world
        self._part = part
        self._number = number
        self._member = member
        self._task = task
        self._script = script_of(task)
        self._hand_actions = HandActions(task)
        self._playing: dict[int, Actions] = {}  # by row among the class's environments
        self._sensors = part.group.engine.sensordata[member.engine_rows]

    def write(self, actions: Tensor) -> None:
        """Write the next action of each script into ``actions`` (N, a), the actions of all the world's environments.

        If a script has ended, its row stays as it is.
        """
        self._sensors = self._part.group.engine.sensordata[self._member.engine_rows].clone()
        leads = {row: lead for row, script in self._playing.items() if (lead := next(script, None)) is not None}
        if leads:
            rows = torch.tensor(list(leads))
            sensors = self._sensors[rows]
            found = self._hand_actions(list(leads.values()), lambda name: sensors[:, self._member.scene.sensors[name]])
            actions[self._member.env_ids][rows, : found.shape[1]] = found

    def begin(self, env_mask: Tensor) -> None:
        """Begin a new script in those environments of the class that are in a mask (N,)."""
        for row in env_mask[self._member.env_ids].nonzero().flatten().tolist():
            self._playing[row] = self._begin(row)

    def _begin(self, row: int) -> Actions:
        """Start the script of an environment of this class, and yield its targets.

        The script first reads the state when the first target is requested. ``row`` is the index of the environment
        among the environments of the class.
        """
        place = self._member.env_ids.start + row
        tasks = self._world.num_slot_tasks[self._member.slot]
        given = (self._world.task_index[place : place + 1] + self._ahead) % tasks
        frozen = self._part.frozen(self._number, given)
        places = self._member.scene.sensors
        hands = HandController(self._task, lambda name: self._sensors[row, places[name]], lambda name: frozen[name][0])
        yield from self._script(hands)


class ShiftedStarts(PooledWorldWrapper):
    """Environments that play task 0 of one class and start near the start of the class's witness.

    A witness is a recording of actions that solve this task. Each start moves every object and fixture horizontally to
    a random point within ``shift`` metres.
    """

    world: World

    def __init__(self, name: str, rows: int, shift: float, threads: int | None = None) -> None:
        super().__init__(
            World([task_slot(name)], WorldConfig(rows, autoreset_mode="DISABLED", seed=SEED, threads=threads))
        )
        self._shift = shift

    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[Tensor, Info]:
        """Start episodes in all environments, with shifts that ``seed`` determines.

        Raises BidexError if ``options`` are given.
        """
        if options:
            raise BidexError("Shifted starts begin all environments together. Leave options out.")
        self.world.reset(seed=SEED)
        (part,) = self.world.parts
        engine = part.group.engine
        rows = self.num_envs
        starts = engine.placement()[0].expand(rows, -1).clone()
        generator = torch.Generator().manual_seed(SEED if seed is None else seed)
        for name, where in part.group.members[0].scene.qpos.items():
            if "/" in name:  # such a name is a joint or a hand
                continue
            angle, size = torch.rand(2, rows, generator=generator, dtype=starts.dtype)
            way = torch.stack([(2.0 * torch.pi * angle).cos(), (2.0 * torch.pi * angle).sin()], 1)
            starts[:, where.start : where.start + 2] += self._shift * size.sqrt()[:, None] * way
        engine.reset(torch.ones(rows, dtype=torch.bool), starts)
        # Loading a state makes the world return the observations of these starts.
        action = torch.zeros(self.world.action_space.shape)
        obs = part.observe(list(part.states(self.world.task_index)), action, *base_rotations([part]))
        self.world.load_state_dict(self.world.state_dict() | {"observation": obs})
        return obs.clone(), {}

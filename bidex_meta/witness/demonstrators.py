"""Witnesses and scripted policies as agents, and the shifted starts from which demonstrations begin."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from bidex_meta.errors import BidexError
from bidex_meta.witness.controller import HandController
from bidex_meta.witness.replay import SEED, Simulator, task_slot
from bidex_meta.witness.scripts import script_of
from bidex_meta.witness.store import Witness
from bidex_meta.world import World
from bidex_meta.world.contract import Info, Options
from bidex_meta.world.part import base_rotations
from bidex_meta.world.wrapper import PooledWorldWrapper


class ActionSequences:
    """Plays ``sequences`` (n, steps, action), ``which`` of them in each environment, and repeats the last action."""

    def __init__(self, sequences: Tensor, which: Tensor):
        self._sequences, self._which, self._step = sequences, which, torch.zeros_like(which)

    def eval_action(self, obs: Tensor) -> Tensor:
        """The next actions (num_envs, action)."""
        action = self._sequences[self._which, self._step.clamp_max(self._sequences.shape[1] - 1)]
        self._step += 1
        return action

    def reset(self, env_mask: Tensor) -> None:
        """These environments begin again."""
        self._step[env_mask] = 0

    def _store(self, sequence: int, actions: Tensor) -> None:
        """Puts actions (T, a) into the first columns of a sequence, and repeats the last one to its end."""
        into = self._sequences[sequence]
        into[:, : actions.shape[1]] = actions[torch.arange(len(into)).clamp_max(len(actions) - 1)]


class OpenLoopReplay(ActionSequences):
    """Plays the witness of each environment's class, without observations; a class without one gets zero actions.

    ``task_names`` are the classes of the world's slots, ``task_id`` the slot of each environment, ``actions`` the size
    of the world's actions, which may be padded; ``noise`` is a standard deviation.
    """

    def __init__(
        self, witnesses: Mapping[str, Witness], task_names: Sequence[str], task_id: Tensor, actions: int,
        noise: float = 0.0, seed: int = 0
    ):  # fmt: skip
        longest = max((len(each.actions) for each in witnesses.values()), default=1)
        super().__init__(torch.zeros(len(task_names), longest, actions, device=task_id.device), task_id)
        for slot, name in enumerate(task_names):
            if name in witnesses:
                self._store(slot, torch.from_numpy(witnesses[name].actions))
        self._noise, self._generator = noise, torch.Generator(task_id.device).manual_seed(seed)

    def eval_action(self, obs: Tensor) -> Tensor:
        """The next actions (num_envs, action)."""
        action = super().eval_action(obs)
        if self._noise:
            noise = torch.randn(action.shape, generator=self._generator, device=action.device)
            action = (action + self._noise * noise).clamp(-1.0, 1.0)
        return action


class Scripted(ActionSequences):
    """Plays a class's script, computed at the start of each episode in a copy of the environment with full state.

    ``world`` is of one class with moving bases, on C MuJoCo, in autoreset mode DISABLED; the script reacts to the noise
    (standard deviation) on its actions. Raises BidexError for a class without a script.
    """

    def __init__(self, world: World, noise: float = 0.0, seed: int = 0):
        (name,), rows = world.task_names, world.num_envs
        self._script, self._world = script_of(name), world
        self._copy = Simulator(name, 1, threads=1)
        super().__init__(torch.zeros(rows, self._copy.episode_steps, self._copy.action_size), torch.arange(rows))
        self._noise, self._generator = noise, torch.Generator().manual_seed(seed)

    def reset(self, env_mask: Tensor) -> None:
        """These environments are at the start of an episode."""
        super().reset(env_mask)
        states = self._world.parts[0].group.engine.state_dict()
        for row in env_mask.nonzero().flatten().tolist():
            task = self._world.slots[0].tasks[int(self._world.task_index[row])]
            self._copy.take(task, {name: value[row].clone() for name, value in states.items()})
            hands = HandController(self._copy, self._noise, self._generator)
            self._script(hands)
            self._store(row, torch.stack(hands.actions))


class ShiftedStarts(PooledWorldWrapper):
    """A class's task 0 from its witness's start, objects and fixtures shifted over a disc of ``shift`` metres."""

    world: World

    def __init__(self, name: str, rows: int, shift: float, threads: int | None = None) -> None:
        super().__init__(World([task_slot(name)], rows, autoreset_mode="DISABLED", seed=SEED, threads=threads))
        self._shift = shift

    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[Tensor, Info]:
        """Starts episodes of all environments, shifted by the seed; raises BidexError for options."""
        if options:
            raise BidexError("Shifted starts begin all environments together. Leave options out.")
        self.world.reset(seed=SEED)
        (part,) = self.world.parts
        engine, rows = part.group.engine, self.num_envs
        starts = engine.placement()[0].expand(rows, -1).clone()
        generator = torch.Generator().manual_seed(SEED if seed is None else seed)
        for name, where in part.group.members[0].scene.qpos.items():
            if "/" in name:  # a joint, or a hand
                continue
            angle, size = torch.rand(2, rows, generator=generator, dtype=starts.dtype)
            way = torch.stack([(2.0 * torch.pi * angle).cos(), (2.0 * torch.pi * angle).sin()], 1)
            starts[:, where.start : where.start + 2] += self._shift * size.sqrt()[:, None] * way
        engine.reset(torch.ones(rows, dtype=torch.bool), starts)
        # Loading a state makes the world return observations of these starts.
        action = torch.zeros(self.world.action_space.shape)
        obs = part.observe(list(part.states(self.world.task_index)), action, *base_rotations([part]))
        self.world.load_state_dict(self.world.state_dict() | {"observation": obs})
        return obs.clone(), {}

"""Replay of witnesses (recorded actions that solve a task), from their own start and from slightly shifted starts.

The shifts are a tenth of a millimetre; they show whether a witness succeeds by more than luck.
"""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bidex_meta.benchmark import Benchmark
from bidex_meta.errors import unknown_name
from bidex_meta.rules import plain_name
from bidex_meta.witness.controller import Actions, HandActions, HandController
from bidex_meta.witness.store import Witness
from bidex_meta.world import Slot, World, WorldConfig
from bidex_meta.world.part import judgement_of

# Witnesses solve task 0 of each class of this suite and seed.
SUITE = "MT20"
SEED = 0
SHIFT = 1e-4  # how far the objects' start is shifted to see whether a witness succeeds by more than luck, metres
SHIFTED = 10  # number of shifted starts in a replay

State = dict[str, Tensor]


@dataclass(frozen=True)
class Trace:
    """Results of T steps of N environments."""

    rewards: Tensor  # unscaled rewards, (T, N), float64; 0 after an episode has ended
    least: Tensor  # smallest of the reward's terms, times the number of terms; shape and zeros as in ``rewards``
    success: Tensor  # bool (T, N); false after an episode has ended
    alive: Tensor  # bool (N,): the episode has not failed, and its physics has not broken


def task_slot(name: str) -> Slot:
    """Return a slot (a class with its tasks) whose only task is the one that the class's witness solves.

    A witness is a recording of actions that solve a task. For a name such as ``DoorOpenInward-v2``, class and task have
    the rules of version 2. Raises BidexError for an unknown class.
    """
    plain = plain_name(name)
    benchmark = Benchmark(SUITE if plain == name else f"{SUITE}-v2", seed=SEED)
    classes = benchmark.task_classes()
    if plain not in classes:
        raise unknown_name("task", name, classes)
    return Slot(name, classes[plain], benchmark.tasks_of(plain)[0].variation[None])


class Simulator:
    """``num`` environments of a class that all play the task of the class's witness, from the same start.

    They have the world's physics and rewards, but no episodes, so they never reset themselves.
    """

    def __init__(self, name: str, num: int, threads: int | None = None):
        slot = task_slot(name)
        self.num = num
        self.task = slot.task_class
        self.action_size = self.task.action_size
        self.episode_steps = self.task.episode_steps
        self._world = World([slot], WorldConfig(num, autoreset_mode="DISABLED", seed=SEED, threads=threads))
        self._world.reset(seed=SEED)
        self._part = self._world.parts[0]
        self._engine = self._part.group.engine
        self._start = self._engine.placement()[0]
        self._everyone = torch.ones(num, dtype=torch.bool)
        self._engine.reset(self._everyone, self._start.expand(num, -1))

    def starts(self, shifted: int, seed: int = SEED) -> list[State]:
        """Return the start state, followed by ``shifted`` shifted starts.

        In a shifted start every object and movable fixture is moved horizontally by 0.1 mm in a random direction.
        """
        generator = torch.Generator().manual_seed(seed)
        places = self._part.group.members[0].scene.qpos
        objects = [where for part, where in places.items() if "/" not in part]
        states = []
        for i in range(shifted + 1):
            start = self._start.clone()
            for where in objects if i else []:
                angle = 2.0 * torch.pi * torch.rand(1, generator=generator, dtype=start.dtype)
                start[where.start : where.start + 2] += SHIFT * torch.cat((angle.cos(), angle.sin()))
            self._engine.reset(self._everyone, start.expand(self.num, -1))
            states.append(self.save(0))
        return states

    def save(self, row: int) -> State:
        """Return a copy of the state of an environment."""
        return {name: value[row].clone() for name, value in self._engine.state_dict().items()}

    def load(self, states: list[State]) -> None:
        """Set the environments to these states; each state is used for an equal number of consecutive environments.

        The number of states must divide ``num``.
        """
        stacked = {name: torch.stack([state[name] for state in states]) for name in states[0]}
        share = self.num // len(states)
        self._engine.load_state_dict({name: each.repeat_interleave(share, dim=0) for name, each in stacked.items()})

    def play(self, actions: Tensor, each_step: Callable[[], None] | None = None) -> Trace:
        """Play actions (T, N, action_size) in [-1, 1] from the present state, with a callback after each step."""
        alive = torch.ones(self.num, dtype=torch.bool)
        rewards = []
        least = []
        success = []
        for action in actions:
            self._part.step(action, None)
            (_, _, state), *_ = self._part.states(self._world.task_index)
            transition = judgement_of(self._part.group.members[0].scene.task, state)
            alive &= ~self._part.unstable()
            terms = torch.stack(list(transition.terms.values()))
            rewards.append(torch.where(alive, transition.reward, 0.0))
            least.append(torch.where(alive, len(terms) * terms.amin(0), 0.0))
            success.append(alive & transition.success)
            alive &= ~transition.failed
            if each_step is not None:
                each_step()
        return Trace(torch.stack(rewards), torch.stack(least), torch.stack(success), alive)

    def led(self, script: Callable[[HandController], Actions]) -> Iterator[tuple[Tensor, Trace]]:
        """Play one script in all environments at once; yield the action (action_size,) and the results of each step.

        All environments get the same action. The script reads the mean of each sensor over the environments.
        """
        hands = HandController(self.task, lambda name: self.sensor(name).mean(0), lambda name: self.frozen(name)[0])
        actions = HandActions(self.task)
        for lead in script(hands):
            (action,) = actions([lead], lambda name: self.sensor(name).mean(0, keepdim=True))
            yield action, self.play(action.expand(1, self.num, -1))

    def sensor(self, name: str) -> Tensor:
        """Return a copy of a sensor's values, (N, k)."""
        return self._engine.sensordata[:, self._part.group.members[0].scene.sensors[name]].clone()

    def frozen(self, name: str) -> Tensor:
        """Return the value ``name`` (N, k) that the task fixes, such as the goal."""
        return self._part.frozen(0, self._world.task_index)[name]

    def contact_depth(self, row: int) -> float:
        """Return the deepest penetration among an environment's contacts, metres."""
        return self._engine.contact_depth(row)

    def picture(self, width: int = 640, height: int = 480, camera: str | None = None) -> np.ndarray:
        """Draw the first environment, (height, width, 3) uint8."""
        return self._world.render(env_id=0, width=width, height=height, camera=camera)

    def close(self) -> None:
        """End the engine."""
        self._world.close()


@dataclass(frozen=True)
class Replay:
    """Result of replaying a witness (recorded actions) from its own start and from shifted starts."""

    total: float  # return from the unshifted start
    first_success: int | None  # index of the first successful step from the unshifted start
    succeeded: int  # number of shifted starts from which the replay succeeds
    depths: Tensor  # deepest contact after each step from each start, metres, (steps, 1 + shifted starts)

    @property
    def deepest(self) -> float:
        """Return the depth of the deepest contact in the replay from the unshifted start, metres.

        A large depth shows that one body passed through another.
        """
        return float(self.depths[:, 0].max())

    @property
    def found(self) -> bool:
        """Return whether the replayed actions are good enough for a witness.

        The replay must succeed from the unshifted start and from at least eight of the ten shifted starts.
        """
        return self.first_success is not None and self.succeeded >= 8


def frames(
    name: str, witness: Witness, at: Collection[int] | None = None, camera: str | None = None, **size: int
) -> Iterator[np.ndarray]:
    """Replay a witness, which is a recording of actions, and yield pictures (height, width, 3), uint8.

    A picture is drawn before the first step and after every step. If ``at`` is given, pictures are drawn only after
    these numbers of played steps; 0 stands for the start. ``size`` may give ``width`` and ``height`` in pixels.
    """
    simulator = Simulator(name, 1, threads=1)
    for played in range(len(witness.actions) + 1):
        if at is None or played in at:
            yield simulator.picture(camera=camera, **size)
        if played < len(witness.actions):
            simulator.play(torch.from_numpy(witness.actions[played])[None, None])
    simulator.close()


def replay(name: str, witness: Witness, threads: int | None = None) -> Replay:
    """Play a witness (recorded actions) from its own start and from ten shifted starts, and return the results."""
    simulator = Simulator(name, 1 + SHIFTED, threads)
    simulator.load(simulator.starts(SHIFTED))
    actions = torch.from_numpy(witness.actions)[:, None].expand(-1, simulator.num, -1)
    depths: list[list[float]] = []
    trace = simulator.play(actions, lambda: depths.append([simulator.contact_depth(i) for i in range(simulator.num)]))
    simulator.close()
    steps = trace.success[:, 0].nonzero().flatten().tolist()
    succeeded = int(trace.success.any(dim=0)[1:].sum())
    return Replay(float(trace.rewards[:, 0].sum()), steps[0] if steps else None, succeeded, torch.tensor(depths))

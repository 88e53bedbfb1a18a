"""What all batched worlds share: reset, step, autoreset, episodes and ``info``; subclasses fill in the physics.

``world.World`` is the one of hands; Meta-World's and Gymnasium's Humanoid are ``foreign_world.ForeignWorld``.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Self, cast

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from bidex_meta.errors import BidexError
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.validation import Text, true_or_false
from bidex_meta.world import checked
from bidex_meta.world.contract import Info, ObservationGroup, Options, State, Step
from bidex_meta.world.episodes import Clock, Episodes, checked_mode, checked_seed, ended_info, reset_mask
from bidex_meta.world.random import row_keys
from bidex_meta.world.threads import one_torch_thread
from bidex_meta.world.wrapper import NumpyWorld


class Slots(NamedTuple):
    """The slots of a world, one list entry each."""

    names: list[str]
    episode_steps: list[int]
    reward_scales: list[float]
    gammas: list[float | None]


class Transition(NamedTuple):
    """A step of n environments, before rewards are scaled and broken ones cleaned: (n, d), float32 and bool (n,)."""

    obs: Tensor
    reward: Tensor
    success: Tensor
    failed: Tensor
    """The episode came to a true end."""
    unstable: Tensor
    """The physics broke."""
    terms: dict[str, Tensor]
    """Reward terms by name, each (n,), 0 in environments of classes without the term."""


class BatchedWorld(VectorEnv, ABC):
    """Environments of some slots, split evenly and contiguously over them: a ``contract.TaskWorld``.

    Worlds pickle and copy: a copy is built anew and continues bit for bit. Of attributes set from outside only
    ``stagger`` is copied.
    """

    single_observation_space: Box
    single_action_space: Box
    observation_space: Box
    action_space: Box
    num_id_columns: int
    observation_groups: tuple[ObservationGroup, ...]
    success_at_end = False
    _masked = False
    """Whether nothing in a step may look at a number (accelerators)."""
    _arguments: tuple[tuple[Any, ...], dict[str, Any]]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:  # noqa: D102
        world = super().__new__(cls)
        world._arguments = args, kwargs
        return world

    def __reduce__(self) -> tuple[Any, ...]:
        return _recreate, (type(self), *self._arguments, self.state_dict(), self._ready, self.stagger)

    def __init__(
        self,
        slots: Slots,
        num_envs: int,
        device: torch.device,
        autoreset_mode: str | AutoresetMode | None,
        stagger: bool,
    ) -> None:
        """Splits the environments over the slots; a subclass sets spaces, pools and the seed.

        ``autoreset_mode`` is SAME_STEP (training), NEXT_STEP (training by Gymnasium's tools) or DISABLED (evaluation);
        with ``stagger`` first episodes begin at a random elapsed step (not in DISABLED). Raises BidexError for fewer
        environments than slots, or an unknown mode.
        """
        self.num_envs, self.device = checked.num_envs(num_envs, slots.names), device
        self.autoreset_mode = checked_mode(autoreset_mode)
        self.stagger = true_or_false("stagger", stagger)
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": []}
        self.task_names, self.gammas = list(slots.names), tuple(slots.gammas)
        self._slots = slots
        self.num_tasks = len(self.task_names)
        self.slot_rows = split_rows(self.num_envs, self.num_tasks)
        counts = [rows.stop - rows.start for rows in self.slot_rows]
        self.task_id = torch.arange(self.num_tasks).repeat_interleave(torch.tensor(counts)).to(device)
        self._index_in_slot = torch.cat([torch.arange(count, device=device) for count in counts])
        self.max_episode_steps = self._by_slot(slots.episode_steps)
        self._scale = self._by_slot(slots.reward_scales).float()
        self._clock = Clock(self.num_envs, device)
        self._ready = False

    def _by_slot(self, values: Sequence[float]) -> Tensor:
        return torch.tensor(values, device=self.device)[self.task_id]

    def _set_spaces(self, single_observation: Box, action_size: int) -> None:
        spaces = make_spaces(single_observation, action_size, self.num_envs)
        self.single_observation_space, self.single_action_space = spaces.single_observation, spaces.single_action
        self.observation_space, self.action_space = spaces.observation, spaces.action
        self.observation_size, self.action_size = int(np.prod(single_observation.shape)), action_size
        self._obs = torch.zeros(self.num_envs, self.observation_size, device=self.device)
        self._action = torch.zeros(self.num_envs, action_size, device=self.device)

    def _set_pool_sizes(self, sizes: list[int]) -> None:
        """The next reset must be of all environments."""
        self.num_slot_tasks = sizes
        self._pool_size = self._by_slot(sizes)
        self.task_index = self._index_in_slot % self._pool_size
        self._ready = False

    def _set_seed(self, seed: object) -> None:
        self.seed = checked.seed(seed)
        self._keys = self._random_keys()
        self.episodes = Episodes.fresh(self.num_envs, self.device)

    def _random_keys(self, what: str = "") -> Tensor:
        """Keys of the environments, (n, 2), for one of the things that are drawn."""
        pairs = zip(self.task_names, self.slot_rows, strict=True)
        return torch.cat([row_keys(self.seed, name + what, r.stop - r.start, self.device) for name, r in pairs])

    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[Tensor, Info]:
        """Starts episodes of all environments, or those of ``options["reset_mask"]``; see ``VectorWorld.reset``."""
        mask = reset_mask(options, self.num_envs, self.device, self._ready)
        if seed is not None:
            self._set_seed(checked_seed(seed, mask))
        first = not self._ready or seed is not None
        stagger = self.stagger and first and self.autoreset_mode != AutoresetMode.DISABLED
        self._ready = True
        with one_torch_thread():
            self._begin(mask, stagger)
        return self._obs.clone(), {}

    def step(self, action: Tensor | np.ndarray) -> Step:
        """Advances every environment by one control step; see ``VectorWorld.step``.

        ``action`` (num_envs, a) may be a NumPy array. Raises BidexError where it is not real numbers of that shape, and
        before the first reset.
        """
        if not self._ready:
            raise BidexError("Expected reset() before step(): the environments have no episode yet.")
        action = checked.action(action, (self.num_envs, self.action_size), self.device)
        with one_torch_thread():
            waiting = self.episodes.finished
            active, broken = self._run("control", self._control, action)
            reward, terminated, truncated, info = self._move(active, broken)
            self._clock.stamp(info)
            ended = info["_final_obs"]
            if self.autoreset_mode == AutoresetMode.NEXT_STEP:
                ended = waiting
                terminated, truncated = terminated & ~waiting, truncated & ~waiting
                info |= {name: info[name] & ~waiting for name in ("success", "solved")}
            if self.autoreset_mode != AutoresetMode.DISABLED and (self._masked or ended.any()):
                self._begin(ended, stagger=False)
            return self._obs.clone(), reward, terminated, truncated, info

    def _run(self, name: str, work: Callable[..., Any], *inputs: Tensor) -> Any:
        """A stretch of a step that reads no number on the host; a recorded graph of it is replayed."""
        return work(*inputs)

    def _begin(self, mask: Tensor, stagger: bool) -> None:
        self._clock.begin(mask)
        self._start(mask, stagger)

    @abstractmethod
    def _start(self, mask: Tensor, stagger: bool) -> None:
        """Starts the environments of a mask (``_count_episodes``) and writes their observations into ``_obs``."""

    def _count_episodes(self, mask: Tensor, task_index: Tensor, share: Tensor, stagger: bool) -> None:
        """New episodes in the environments of a mask, of these tasks, at a share of the time limit if staggered."""
        self.episodes.number = self.episodes.number + mask
        self.task_index = torch.where(mask, task_index, self.task_index)
        elapsed = (share * self.max_episode_steps).long() if stagger else torch.zeros_like(self.episodes.elapsed)
        self.episodes.begin(mask, elapsed)

    def _control(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Passes actions on; which environments are active, and which of them got a non-finite number."""
        action, broken = checked.clean(action)
        active = ~self.episodes.finished
        self._write_action(action, active)
        return active, broken & active

    def _write_action(self, action: Tensor, active: Tensor) -> None:
        self._action = action

    def _move(self, active: Tensor, broken: Tensor) -> tuple[Tensor, Tensor, Tensor, Info]:
        """Physics, then rewards, terminated, truncated and info, before new episodes start."""
        return self._finish(active, broken, self._advance(active, broken))

    @abstractmethod
    def _advance(self, active: Tensor, broken: Tensor) -> Transition:
        """Steps the ``active`` environments under ``_action``; of others only success is read.

        ``broken``: those of them whose action was not finite; of these nothing is read.
        """

    def _finish(self, active: Tensor, broken: Tensor, transition: Transition) -> tuple[Tensor, Tensor, Tensor, Info]:
        obs, unstable = transition.obs, transition.unstable | broken
        valid = active & ~unstable
        solved = transition.success & ~unstable
        unscaled = torch.where(valid, transition.reward, 0.0)
        reward = unscaled * self._scale
        episodes = self.episodes
        episodes.add(active, reward, unscaled, solved)
        terminated = transition.failed & valid | episodes.terminated
        late = (episodes.elapsed >= self.max_episode_steps) & ~terminated
        truncated = (late | unstable) & active | episodes.truncated
        ended = (terminated | truncated) & active
        if self._masked or not valid.all():  # on the CPU looking costs less than a pass over all observations
            obs = torch.where(valid[:, None], obs, self._obs)
        info: Info = {
            "success": episodes.solved_at_end if self.success_at_end else solved,
            "solved": solved,
            "unstable": unstable & active,
            "reward_unscaled": unscaled,
            "final_obs": obs,
            "_final_obs": ended,
            "running": episodes.statistics(self.success_at_end),
            "episode_mask": ended & episodes.counts,
        }
        if transition.terms:
            info["reward_terms"] = {name: torch.where(valid, term, 0.0) for name, term in transition.terms.items()}
        if self._masked or ended.any():
            info |= ended_info(info)
        self._obs = obs.clone()
        if self.autoreset_mode != AutoresetMode.SAME_STEP:
            episodes.terminated, episodes.truncated = terminated.clone(), truncated.clone()
            episodes.finished = episodes.finished | ended
        return reward, terminated, truncated, info

    def state_dict(self) -> State:
        """Tensors and plain values, copied, from which the world continues bit for bit."""
        state = {"made": self._made(), "seed": self.seed, "episodes": self.episodes.state_dict()}
        return state | {"task_index": self.task_index.clone(), "observation": self._obs.clone()}

    def _made(self) -> dict[str, str]:
        """Return what decides the world's future beside its state, as texts by name.

        A state is loaded into a world with the same. Devices, engines, threads and pictures are left out, since a run
        may continue with others, and modes, since what was begun in training may be played to its end in evaluation.
        """
        made = {"slots": ", ".join(self.task_names)}
        for name, steps, scale in zip(*self._slots[:3], strict=True):
            made |= {f"time limit of {name}": str(steps), f"reward scale of {name}": str(scale)}
        return made

    def _upgraded(self, state: State) -> State:
        """A state of before version 0.3, which has no ``held`` or ``made``, as one of now."""
        episodes = state.get("episodes") if isinstance(state, Mapping) else None
        if not isinstance(episodes, Mapping):
            return state
        held = {"held": torch.zeros(self.num_envs, dtype=torch.int64)}
        return {"made": self._made(), **state, "episodes": held | dict(episodes)}

    @abstractmethod
    def load_state_dict(self, state: State) -> None:
        """Restores a ``state_dict`` of a world built alike; all of it or nothing."""

    def _restore(self, state: State) -> None:
        self._set_seed(int(state["seed"]))
        self.episodes.load_state_dict(state["episodes"])
        # Checkpoints are loaded to the CPU, wherever the world lives.
        self.task_index, self._obs = (state[n].to(self.device, copy=True) for n in ("task_index", "observation"))
        self._ready = True

    @property
    def task_name(self) -> list[str]:
        """Slot name of each environment."""
        return [self.task_names[i] for i in self.task_id.tolist()]

    def to_numpy(self, stagger: bool = False) -> NumpyWorld:
        """This world with NumPy arrays, as Gymnasium's vector wrappers expect."""
        return NumpyWorld(self, stagger)

    @checked_arguments
    def get_attr(self, name: str) -> tuple[Any, ...]:
        """An attribute for each environment: its own entry where there is one for each, else the world's value."""
        value = getattr(self, name)
        each = name == "task_name" or (isinstance(value, Tensor) and value.shape[:1] == (self.num_envs,))
        return tuple(value) if each else (value,) * self.num_envs

    @checked_arguments
    def set_attr(self, name: Text, values: Any) -> None:
        """Sets an attribute of the world."""
        setattr(self, name, values)

    @checked_arguments
    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Calls a method of the world (or reads an attribute) and returns the result for each environment."""
        value = getattr(self, name)
        return (value(*args, **kwargs),) * self.num_envs if callable(value) else self.get_attr(name)


class Spaces(NamedTuple):
    """The four of a Gymnasium vector environment."""

    single_observation: Box
    single_action: Box
    observation: Box
    action: Box


def make_spaces(single_observation: Box, action_size: int, num_envs: int) -> Spaces:
    """The spaces of environments with these observations and ``action_size`` actions within [-1, 1]."""
    single = single_observation, Box(-1.0, 1.0, (action_size,), np.float32)
    return Spaces(*single, *(cast(Box, batch_space(space, num_envs)) for space in single))


def split_rows(num_envs: int, slots: int) -> list[slice]:
    """Contiguous environments for each slot, even; the first slots take the remainder."""
    share, rest = divmod(num_envs, slots)
    stops = [share * (i + 1) + min(i + 1, rest) for i in range(slots)]
    return [slice(stop - share - (i < rest), stop) for i, stop in enumerate(stops)]


def _recreate(
    kind: type[BatchedWorld], args: tuple[Any, ...], kwargs: dict[str, Any], state: State, ready: bool, stagger: bool
) -> BatchedWorld:
    world = kind(*args, **kwargs)
    world.load_state_dict(state)
    world._ready, world.stagger = ready, stagger
    return world

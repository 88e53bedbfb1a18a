"""The base of all batched worlds: reset, step, autoreset, episodes and ``info``; subclasses fill in the physics.

``world.World`` holds the hands; Meta-World's suites and Gymnasium's Humanoid are ``foreign_world.ForeignWorld``.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import NamedTuple, Self, cast

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
from bidex_meta.world.graphs import EagerStepper, Stepper
from bidex_meta.world.random import env_keys
from bidex_meta.world.threads import one_torch_thread
from bidex_meta.world.wrapper import NumpyWorld

Outcome = tuple[Tensor, Tensor, Tensor, Info]
"""Rewards, terminated, truncated and info of a step."""


class Slots(NamedTuple):
    """Settings of a world's slots (task classes); each list has one entry per slot."""

    names: list[str]
    episode_steps: list[int]
    reward_scales: list[float]
    gammas: list[float | None]
    num_tasks: list[int]


class Transition(NamedTuple):
    """One step of n environments, before rewards are scaled and values of broken environments are replaced.

    Observations (n, d) and rewards (n,) are float32; flags (n,) are bool.
    """

    obs: Tensor
    reward: Tensor
    success: Tensor
    failed: Tensor
    """True if a rule of the class ends the episode (Gymnasium's ``terminated``)."""
    unstable: Tensor
    """True if the physics broke."""
    terms: dict[str, Tensor]
    """Reward terms by name, each (n,), 0 in environments of classes without the term."""


class BatchedWorld(VectorEnv, ABC):
    """A ``contract.TaskWorld`` that splits its environments evenly over slots, into contiguous ranges.

    A slot is a task class, or in MT1 a single task. Worlds can be pickled and copied. A copy is built from the
    original's arguments and gets the original's state, so that it continues bit for bit. Of the attributes that a user
    may set, only ``stagger`` is copied.
    """

    single_observation_space: Box
    single_action_space: Box
    observation_space: Box
    action_space: Box
    num_id_columns: int
    observation_groups: tuple[ObservationGroup, ...]
    success_at_end = False
    _avoids_syncs = False
    """True if no value of a tensor may be read on the host in a step, because the host would wait for the accelerator.
    """
    _stepper: Stepper = EagerStepper()
    _arguments: tuple[tuple[object, ...], dict[str, object]]

    def __new__(cls, *args: object, **kwargs: object) -> Self:  # noqa: D102
        world = super().__new__(cls)
        world._arguments = args, kwargs
        return world

    def __reduce__(self) -> tuple[object, ...]:
        return _recreate, (type(self), *self._arguments, self.state_dict(), self._ready, self.stagger)

    def __init__(
        self,
        slots: Slots,
        num_envs: int,
        device: torch.device,
        autoreset_mode: str | AutoresetMode | None,
        stagger: bool,
        seed: object,
    ) -> None:
        """Split the environments over the slots; a subclass calls ``_set_spaces`` and builds its own simulation.

        ``autoreset_mode`` is SAME_STEP (training), NEXT_STEP (training by Gymnasium's tools) or DISABLED (evaluation).
        With ``stagger`` the first episode of each environment is shortened by a random number of steps, except in
        DISABLED mode. Raises BidexError for fewer environments than slots, an unknown mode or a seed below 0.
        """
        self.num_envs = checked.num_envs(num_envs, slots.names)
        self.device = device
        self.autoreset_mode = checked_mode(autoreset_mode)
        self.stagger = true_or_false("stagger", stagger)
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": []}
        self.task_names = list(slots.names)
        self.gammas = tuple(slots.gammas)
        self._slots = slots
        self.num_tasks = len(self.task_names)
        self.slot_env_ids = split_envs(self.num_envs, self.num_tasks)
        counts = [rows.stop - rows.start for rows in self.slot_env_ids]
        self.task_id = torch.arange(self.num_tasks).repeat_interleave(torch.tensor(counts)).to(device)
        self._index_in_slot = torch.cat([torch.arange(count, device=device) for count in counts])
        self.max_episode_steps = self._by_slot(slots.episode_steps)
        self._scale = self._by_slot(slots.reward_scales).float()
        self._clock = Clock(self.num_envs, device)
        self._set_pool_sizes(slots.num_tasks)
        self._set_seed(seed)

    def _by_slot(self, values: Sequence[float]) -> Tensor:
        return torch.tensor(values, device=self.device)[self.task_id]

    def _set_spaces(self, single_observation: Box, action_size: int) -> None:
        self.single_observation_space = single_observation
        self.single_action_space = Box(-1.0, 1.0, (action_size,), np.float32)
        self.observation_space = cast(Box, batch_space(single_observation, self.num_envs))
        self.action_space = cast(Box, batch_space(self.single_action_space, self.num_envs))
        self.observation_size = int(np.prod(single_observation.shape))
        self.action_size = action_size
        self._obs = torch.zeros(self.num_envs, self.observation_size, device=self.device)
        self._action = torch.zeros(self.num_envs, action_size, device=self.device)

    def _set_pool_sizes(self, sizes: list[int]) -> None:
        """Set the number of tasks of each slot; the next reset must start all environments."""
        self.num_slot_tasks = sizes
        self._pool_size = self._by_slot(sizes)
        self.task_index = self._index_in_slot % self._pool_size
        self._ready = False

    def _set_seed(self, seed: object) -> None:
        self.seed = checked.seed(seed)
        self._keys = self._random_keys()
        self.episodes = Episodes.fresh(self.num_envs, self.device)

    def _renew_draws(self) -> None:
        """Replace numbers that were drawn in advance, after the seed or the pools of tasks have changed."""

    def _random_keys(self, purpose: str = "") -> Tensor:
        """Return one key per environment, (n, 2), for the random numbers that serve ``purpose``."""
        keys = []
        for name, env_ids in zip(self.task_names, self.slot_env_ids, strict=True):
            keys.append(env_keys(self.seed, name + purpose, env_ids.stop - env_ids.start, self.device))
        return torch.cat(keys)

    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[Tensor, Info]:
        """Start episodes in all environments, or in those of ``options["reset_mask"]``; see ``VectorWorld.reset``."""
        mask = reset_mask(options, self.num_envs, self.device, self._ready)
        if seed is not None:
            self._set_seed(checked_seed(seed, mask))
            self._renew_draws()
        first = not self._ready or seed is not None
        stagger = self.stagger and first and self.autoreset_mode != AutoresetMode.DISABLED
        self._ready = True
        with one_torch_thread():
            self._begin(mask, stagger)
        return self._obs.clone(), {}

    def step(self, action: Tensor | np.ndarray) -> Step:
        """Advance every environment by one control step; see ``VectorWorld.step``.

        ``action`` (num_envs, a) may be a NumPy array. Raises BidexError if it does not hold real numbers in that shape,
        and before the first reset.
        """
        if not self._ready:
            raise BidexError("Expected reset() before step(): the environments have no episode yet.")
        action = checked.action(action, (self.num_envs, self.action_size), self.device)
        with one_torch_thread():
            # A recording of the step overwrites the counters, so the environments that wait now are copied.
            waiting = self.episodes.finished.clone()
            active, broken = self._stepper.run(self._control, action)
            reward, terminated, truncated, info = self._move(active, broken)
            self._clock.stamp(info)
            ended = info["_final_obs"]
            if self.autoreset_mode == AutoresetMode.NEXT_STEP:
                ended = waiting
                terminated = terminated & ~waiting
                truncated = truncated & ~waiting
                info |= {name: info[name] & ~waiting for name in ("success", "solved")}
            if self.autoreset_mode != AutoresetMode.DISABLED and (self._avoids_syncs or ended.any()):
                self._begin(ended, stagger=False)
            return self._obs.clone(), reward, terminated, truncated, info

    def _begin(self, mask: Tensor, stagger: bool) -> None:
        self._clock.begin(mask)
        self._start(mask, stagger)

    @abstractmethod
    def _start(self, mask: Tensor, stagger: bool) -> None:
        """Start episodes in the environments of a mask.

        An implementation must call ``_count_episodes``, and write the first observations into ``_obs``.
        """

    def _count_episodes(self, mask: Tensor, task_index: Tensor, share: Tensor, stagger: bool) -> None:
        """Reset the counters for new episodes in the environments of a mask.

        The episodes play the tasks ``task_index``. With ``stagger`` a ``share`` of their time limits counts as elapsed.
        """
        self.episodes.number = self.episodes.number + mask
        self.task_index = torch.where(mask, task_index, self.task_index)
        if stagger:
            elapsed = (share * self.max_episode_steps).long()
        else:
            elapsed = torch.zeros_like(self.episodes.elapsed)
        self.episodes.begin(mask, elapsed)

    def _control(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Apply actions; return which environments are active, and which active ones got a non-finite action."""
        action, broken = checked.clean(action)
        active = ~self.episodes.finished
        self._write_action(action, active)
        return active, broken & active

    def _write_action(self, action: Tensor, active: Tensor) -> None:
        self._action = action

    @abstractmethod
    def _move(self, active: Tensor, broken: Tensor) -> Outcome:
        """Step the ``active`` environments with the actions in ``_action``, and return the result of ``_finish``.

        The caller starts new episodes afterwards. ``broken`` marks active environments whose action was not finite.
        """

    def _finish(self, active: Tensor, broken: Tensor, transition: Transition) -> Outcome:
        """Count the step in the active environments, and return reward, terminated, truncated and info.

        ``broken`` marks active environments whose action was not finite: they count as unstable. For inactive
        environments only the fields ``success`` and ``unstable`` of the transition are read.
        """
        obs = transition.obs
        unstable = transition.unstable | broken
        valid = active & ~unstable
        solved = transition.success & ~unstable
        unscaled = torch.where(valid, transition.reward, 0.0)
        reward = unscaled * self._scale
        episodes = self.episodes
        episodes.add(active, reward, unscaled, solved, unstable)
        terminated = transition.failed & valid | episodes.terminated
        late = (episodes.elapsed >= self.max_episode_steps) & ~terminated
        truncated = (late | unstable) & active | episodes.truncated
        ended = (terminated | truncated) & active
        if self._avoids_syncs or not valid.all():  # on the CPU this check costs less than a pass over all observations
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
        if self._avoids_syncs or ended.any():
            info |= ended_info(info)
        self._obs = obs.clone()
        if self.autoreset_mode != AutoresetMode.SAME_STEP:
            episodes.terminated = terminated.clone()
            episodes.truncated = truncated.clone()
            episodes.finished = episodes.finished | ended
        return reward, terminated, truncated, info

    def state_dict(self) -> State:
        """Return copies of the tensors and plain values from which the world continues bit for bit."""
        state = {"made": self._made(), "seed": self.seed, "episodes": self.episodes.state_dict()}
        return state | {"task_index": self.task_index.clone(), "observation": self._obs.clone()}

    def _made(self) -> dict[str, str]:
        """Return the settings that, together with the state, determine the world's future, as texts by name.

        A state is loaded only into a world whose texts are the same. Devices, engines, threads and pictures are left
        out, because a run may continue with different ones. Autoreset modes are left out, because an evaluation may
        finish episodes that began in training.
        """
        made = {"slots": ", ".join(self.task_names)}
        for name, steps, scale in zip(*self._slots[:3], strict=True):
            made |= {f"time limit of {name}": str(steps), f"reward scale of {name}": str(scale)}
        return made

    @abstractmethod
    def load_state_dict(self, state: State) -> None:
        """Restore a ``state_dict`` of a world made in the same way. If an error is raised, nothing has changed."""

    def _restore(self, state: State) -> None:
        self._set_seed(int(state["seed"]))
        self._renew_draws()
        self.episodes.load_state_dict(state["episodes"])
        # Checkpoints are loaded to the CPU, whatever the device of the world.
        self.task_index = state["task_index"].to(self.device, copy=True)
        self._obs = state["observation"].to(self.device, copy=True)
        self._ready = True

    @property
    def task_name(self) -> list[str]:
        """Name of each environment's slot."""
        return [self.task_names[i] for i in self.task_id.tolist()]

    def to_numpy(self, stagger: bool = False) -> NumpyWorld:
        """Return this world with NumPy arrays, as Gymnasium's vector wrappers expect."""
        return NumpyWorld(self, stagger)

    @checked_arguments
    def get_attr(self, name: str) -> tuple[object, ...]:
        """Return the value of an attribute for each environment.

        If the attribute has one entry per environment, each environment gets its own entry. Otherwise every environment
        gets the whole value.
        """
        value = getattr(self, name)
        has_entries = name == "task_name" or (isinstance(value, Tensor) and value.shape[:1] == (self.num_envs,))
        if has_entries:
            return tuple(value)
        return (value,) * self.num_envs

    @checked_arguments
    def set_attr(self, name: Text, values: object) -> None:
        """Set an attribute of the world."""
        setattr(self, name, values)

    @checked_arguments
    def call(self, name: str, *args: object, **kwargs: object) -> tuple[object, ...]:
        """Call a method of the world (or read an attribute) and return the result for each environment."""
        value = getattr(self, name)
        if callable(value):
            return (value(*args, **kwargs),) * self.num_envs
        return self.get_attr(name)


def split_envs(num_envs: int, slots: int) -> list[slice]:
    """Return the contiguous environments of each slot; the split is even, and the first slots take the remainder."""
    share, rest = divmod(num_envs, slots)
    stops = [share * (i + 1) + min(i + 1, rest) for i in range(slots)]
    return [slice(stop - share - (i < rest), stop) for i, stop in enumerate(stops)]


def _recreate(
    kind: Callable[..., BatchedWorld],
    args: tuple[object, ...],
    kwargs: dict[str, object],
    state: State,
    ready: bool,
    stagger: bool,
) -> BatchedWorld:
    world = kind(*args, **kwargs)
    world.load_state_dict(state)
    world._ready = ready
    world.stagger = stagger
    return world

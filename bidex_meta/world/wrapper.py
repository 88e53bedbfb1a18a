"""Base classes for wrappers of a world, such as recorders, and the NumPy form that Gymnasium expects.

Extend the base class that fits the world, e.g. ``PooledWorldWrapper`` for a ``PooledWorld``: evaluation and learners
then still see what the world can do. Override the methods that are to do more::

    class Count(WorldWrapper):
        steps = 0

        def step(self, action):
            self.steps += 1
            return super().step(action)
"""

from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv
from torch import Tensor

from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.world import checked
from bidex_meta.world.contract import Info, Options, PooledWorld, State, Step, TaskWorld, VectorWorld
from bidex_meta.world.episodes import ended_info, set_stagger

_OF_THE_CONTRACT = (
    "running",
    "episode_mask",
    "final_obs",
    "_final_obs",
    "episode",
    "_episode",
    "final_info",
    "_final_info",
)


class WorldWrapper(VectorWorld):
    """A ``VectorWorld`` that passes every call on to the wrapped world, and reads attributes from it at each use."""

    @checked_arguments
    def __init__(self, world: VectorWorld) -> None:
        self.world = world

    def __getattr__(self, name: str) -> Any:
        if name == "world":  # the world is not set yet, as in copies
            raise AttributeError(name)
        return getattr(self.world, name)

    @property
    def unwrapped(self) -> Any:
        """Return the world within all wrappers."""
        return getattr(self.world, "unwrapped", self.world)

    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[Tensor, Info]:
        """See ``VectorWorld``."""
        return self.world.reset(seed=seed, options=options)

    def step(self, action: Tensor, /) -> Step:
        """See ``VectorWorld``."""
        return self.world.step(action)

    def state_dict(self) -> State:
        """Return the wrapped world's state: a run continues from it with or without the wrapper."""
        return self.world.state_dict()

    def load_state_dict(self, state: State, /) -> None:
        """See ``VectorWorld``."""
        self.world.load_state_dict(state)

    def to_numpy(self, stagger: bool = False) -> "NumpyWorld":
        """Return this wrapped world with NumPy arrays, as Gymnasium's vector wrappers expect."""
        return NumpyWorld(self, stagger)

    def close(self) -> None:
        """Free the wrapped world."""
        self.world.close()


class TaskWorldWrapper(WorldWrapper, TaskWorld):
    """A ``TaskWorld`` that passes every call on to the wrapped world."""

    world: TaskWorld


class PooledWorldWrapper(TaskWorldWrapper, PooledWorld):
    """A ``PooledWorld`` that passes every call on to the wrapped world."""

    world: PooledWorld

    @property
    def pools(self) -> list[np.ndarray]:
        """Task pools: one array (n, size) for each slot, with one row of numbers (the variation) per task."""
        return self.world.pools

    def set_tasks(self, pools: dict[str, np.ndarray], /) -> None:
        """Replace the task pools of some slots; see ``PooledWorld``."""
        self.world.set_tasks(pools)


class NumpyWorld(VectorEnv):
    """The result of ``world.to_numpy()``: NumPy arrays, for Gymnasium's vector wrappers.

    ``info`` has ``success``, ``unstable``, ... of every environment. If an episode ended in the step, ``info`` also has
    ``final_obs`` and ``final_info``. ``final_obs`` is an array of objects: the last observation where an episode ended,
    elsewhere None. ``final_info["episode"]`` has r, l, t, success and unscaled. ``info`` itself has no key ``episode``,
    because Gymnasium's ``RecordEpisodeStatistics`` adds this key.

    In DISABLED mode an environment may be stepped after its episode ended, as in the world. The end is reported only in
    the step in which it happens; otherwise wrappers would count each later step as an episode.

    With ``stagger`` a training world shortens the first episode of each environment by a random number of steps. In
    this case wrappers that count steps report episodes that are too short.
    """

    @checked_arguments
    def __init__(self, world: VectorWorld, stagger: bool = False) -> None:
        set_stagger(world, stagger)
        self.world = world
        self.num_envs = world.num_envs
        self.single_observation_space = world.single_observation_space
        self.observation_space = world.observation_space
        self.single_action_space = world.single_action_space
        self.action_space = world.action_space
        self.metadata = world.metadata
        self.render_mode = getattr(world, "render_mode", None)
        self.autoreset_mode = world.metadata["autoreset_mode"]
        self.spec = getattr(world, "spec", None)

    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[np.ndarray, Info]:
        """Start episodes; see ``VectorWorld.reset``."""
        obs, info = self.world.reset(seed=seed, options=options)
        return _array(obs), {name: _arrays(value) for name, value in info.items()}

    def step(self, actions: Tensor | np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]:
        """Take actions (num_envs, a).

        Returns observations (num_envs, d), rewards (num_envs,), float32; terminated, truncated (num_envs,), bool; info.
        """
        *flags, step_info = self.world.step(checked.action(actions, self.world.action_space.shape, self.world.device))
        info: Info = {name: _arrays(value) for name, value in step_info.items() if name not in _OF_THE_CONTRACT}
        ended = _array(step_info["_final_obs"])
        if ended.any():
            step_info = ended_info(step_info) | step_info  # the info of a world contains the elapsed time
            info |= {"final_obs": np.full(self.num_envs, None, dtype=object), "_final_obs": ended}
            for env_id, obs in zip(np.flatnonzero(ended), _array(step_info["final_obs"])[ended], strict=True):
                info["final_obs"][env_id] = obs
            info |= {name: _arrays(step_info[name]) for name in ("final_info", "_final_info")}
        obs, reward, terminated, truncated = map(_array, flags)
        return obs, reward, terminated & ended, truncated & ended, info

    def render(self) -> tuple[np.ndarray, ...]:
        """Return a picture of each environment, (height, width, 3), uint8."""
        world: Any = self.world
        return tuple(world.render(env_id=env_id) for env_id in range(self.num_envs))

    def close_extras(self, **kwargs: object) -> None:
        """Free the world."""
        self.world.close()


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.cpu().numpy()


def _arrays(value: object) -> object:
    """Return a tensor, or each tensor in a dict, as an array; return other values unchanged."""
    if isinstance(value, dict):
        return {name: _arrays(part) for name, part in value.items()}
    if isinstance(value, Tensor):
        return _array(value)
    return value

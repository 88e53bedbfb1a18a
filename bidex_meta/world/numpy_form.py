"""A world as Gymnasium's own vector environments are: NumPy arrays, and in ``info`` its keys where something ended."""

from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv

from bidex_meta.world.autoreset import set_stagger
from bidex_meta.world.contract import VectorWorld
from bidex_meta.world.ends import ended_info

_OF_THE_CONTRACT = ("so_far", "counted", "final_obs", "_final_obs", "episode", "_episode", "final_info", "_final_info")


class NumpyWorld(VectorEnv):
    """What ``world.to_numpy()`` gives, for Gymnasium's vector wrappers and whatever knows NumPy alone.

    ``info`` has what the world tells of every row (``success``, ``unstable``, ...), and where a row ended ``final_obs``
    (an array of objects: observations, None in the others) and ``final_info``, the episode's ``episode`` (r, l, t,
    success, unscaled) within. ``episode`` itself is left to ``RecordEpisodeStatistics``, as Gymnasium leaves it.

    Args:
        world: Is stepped; nothing of it is copied.
        stagger: Whether a training world's first episodes begin at random elapsed steps, so that wrappers which count
            for themselves count them too short; left out, at 0.
    """

    def __init__(self, world: VectorWorld, stagger: bool = False) -> None:
        set_stagger(world, stagger)
        self.world, self.num_envs = world, world.num_envs
        self.single_observation_space, self.observation_space = world.single_observation_space, world.observation_space
        self.single_action_space, self.action_space = world.single_action_space, world.action_space
        self.metadata, self.render_mode = world.metadata, getattr(world, "render_mode", None)
        self.autoreset_mode, self.spec = world.metadata["autoreset_mode"], getattr(world, "spec", None)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Starts episodes; see ``VectorWorld.reset``."""
        obs, info = self.world.reset(seed=seed, options=options)
        return _arrays(obs), info

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Takes actions (num_envs, a).

        Returns:
            Observations (num_envs, d), rewards (num_envs,), float32; terminated, truncated (num_envs,), bool; info.
        """
        *made, told = self.world.step(torch.as_tensor(actions, dtype=torch.float32, device=self.world.device))
        info = {name: _arrays(value) for name, value in told.items() if name not in _OF_THE_CONTRACT}
        ended = _arrays(told["_final_obs"])
        if ended.any():
            told = ended_info(told) | told  # a world may tell it already, with the time on the clock
            info |= {"final_obs": np.full(self.num_envs, None, dtype=object), "_final_obs": ended}
            for row, obs in zip(np.flatnonzero(ended), _arrays(told["final_obs"][told["_final_obs"]]), strict=True):
                info["final_obs"][row] = obs
            info |= {name: _arrays(told[name]) for name in ("final_info", "_final_info")}
        obs, reward, terminated, truncated = map(_arrays, made)
        return obs, reward, terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...]:
        """A picture of each row, (height, width, 3), uint8."""
        world: Any = self.world
        return tuple(world.render(row=row) for row in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Frees the world."""
        self.world.close()


def _arrays(value: Any) -> Any:
    """Tensors, and those of a dict, as arrays."""
    if isinstance(value, dict):
        return {name: _arrays(each) for name, each in value.items()}
    return value.cpu().numpy() if isinstance(value, torch.Tensor) else value

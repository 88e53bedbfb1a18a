"""A world as skrl's environment wrapper: `SequentialTrainer(env=SkrlEnv(world), agents=agent)`.

Requires `pip install 'bidex-meta[skrl]'`.
"""

from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from torch import Tensor

from bidex_meta.clients.needs import check_training, extra
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.validation import Seed
from bidex_meta.world.contract import Info, Step, VectorWorld

with extra("skrl"):
    from skrl.envs.wrappers.torch import Wrapper


class SkrlEnv(Wrapper):
    """All environments of one world as a skrl environment; tensors stay on the world's device.

    skrl's own `wrap_env` would convert the tensors to NumPy arrays and back; this class does not.

    The world must be in autoreset mode NEXT_STEP, because skrl does not read `final_obs`. skrl stores the observation
    that `step` returns as the next observation, bootstraps from it at time limits, and acts on it. In NEXT_STEP mode an
    ended environment returns its last observation. Its next step starts the next episode, with reward 0, regardless of
    the action.

    `infos` are those of the world. If full episodes ended, `infos` also has `episode`: means over these episodes in the
    form that skrl's trainers log. `seed` is the seed of the first reset (None: the world's). `stagger` shortens first
    episodes (docs/clients.md); skrl's "Total reward" counts shortened episodes too. Raises BidexError for a world in
    another mode.
    """

    @checked_arguments
    def __init__(self, world: VectorWorld, seed: Seed | None = None, stagger: bool = False) -> None:
        check_training(world, stagger, AutoresetMode.NEXT_STEP)
        super().__init__(world)
        self.world = world
        self._seed = seed
        self._obs: Tensor | None = None
        self._ended: Tensor | None = None

    @property
    def observation_space(self) -> Box:
        """Return the observation space of one environment."""
        return self.world.single_observation_space

    @property
    def action_space(self) -> Box:
        """Return the action space of one environment."""
        return self.world.single_action_space

    def reset(self) -> tuple[Tensor, Info]:
        """Start all environments in the first call, and only the ended ones in later calls.

        Returns the observations (num_envs, d) and an empty info.
        """
        if self._obs is None:
            self._obs, _ = self.world.reset(seed=self._seed)
        elif self._ended is not None and bool(self._ended.any()):  # skrl resets a single environment itself
            self._obs, _ = self.world.reset(options={"reset_mask": self._ended})
        self._ended = None
        return self._obs, {}

    def step(self, actions: Tensor) -> Step:
        """Take actions (num_envs, a).

        Returns observations (num_envs, d); reward, terminated and truncated (num_envs, 1); and infos.
        """
        with torch.no_grad():
            self._obs, *results, info = self.world.step(actions)
        infos = {name: value for name, value in info.items() if name not in ("episode", "_episode")}
        self._ended = info["_final_obs"]
        episode_mask = info["episode_mask"]
        if bool(episode_mask.any()):
            names = {"r": "Episode / Return", "l": "Episode / Length", "success": "Episode / Success"}
            infos["episode"] = {names[name]: info["running"][name][episode_mask].float().mean() for name in names}
        reward, terminated, truncated = (result[:, None] for result in results)
        return self._obs, reward, terminated, truncated, infos

    def state(self) -> None:
        """Return None: there is no state beyond the policy's observation."""

    def render(self, *args: object, **kwargs: object) -> np.ndarray:
        """Return a picture of one environment, (height, width, 3), uint8."""
        world: Any = self.world
        return world.render(*args, **kwargs)

    def close(self) -> None:
        """Free the world."""
        self.world.close()

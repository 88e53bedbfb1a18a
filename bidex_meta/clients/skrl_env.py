"""A world as skrl's environment wrapper: `SequentialTrainer(env=SkrlEnv(world), agents=agent)`. Extra: `skrl`."""

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
    """All environments of one world on its device, without NumPy in between (as `wrap_env` takes it).

    skrl stores what `step` returns as the next observation, bootstraps from it at time limits, and acts on it. It looks
    for no `final_obs`, so the world must be in mode NEXT_STEP: an ended environment returns its last observation, and
    its next step starts the next episode, with reward 0, whatever the action.

    `infos`: the world's; where episodes that count ended, `episode` has their means as skrl's trainers log them. `seed`
    is of the first reset, None: the world's. `stagger`: shortened first episodes (docs/clients.md), which skrl's "Total
    reward" counts. Raises BidexError for a world in another autoreset mode.
    """

    @checked_arguments
    def __init__(self, world: VectorWorld, seed: Seed | None = None, stagger: bool = False) -> None:
        check_training(world, stagger, AutoresetMode.NEXT_STEP)
        super().__init__(world)
        self.world, self._seed = world, seed
        self._obs: Tensor | None = None
        self._ended: Tensor | None = None

    @property
    def observation_space(self) -> Box:
        """Of one environment."""
        return self.world.single_observation_space

    @property
    def action_space(self) -> Box:
        """Of one environment."""
        return self.world.single_action_space

    def reset(self) -> tuple[Tensor, Info]:
        """Start all environments once, later only ended ones; return the present observations (num_envs, d)."""
        if self._obs is None:
            self._obs, _ = self.world.reset(seed=self._seed)
        elif self._ended is not None and bool(self._ended.any()):  # skrl resets a single environment itself
            self._obs, _ = self.world.reset(options={"reset_mask": self._ended})
        self._ended = None
        return self._obs, {}

    def step(self, actions: Tensor) -> Step:
        """Takes actions (num_envs, a): observations (num_envs, d); reward and both ends (num_envs, 1); infos."""
        with torch.no_grad():
            self._obs, *results, info = self.world.step(actions)
        infos = {name: value for name, value in info.items() if name not in ("episode", "_episode")}
        self._ended = info["_final_obs"]
        episode_mask = info["episode_mask"]
        if bool(episode_mask.any()):
            names = {"r": "Episode / Return", "l": "Episode / Length", "success": "Episode / Success"}
            infos["episode"] = {names[name]: info["running"][name][episode_mask].float().mean() for name in names}
        reward, terminated, truncated = (each[:, None] for each in results)
        return self._obs, reward, terminated, truncated, infos

    def state(self) -> None:
        """None: the policy sees what there is."""

    def render(self, *args: object, **kwargs: object) -> np.ndarray:
        """A picture of one environment, (height, width, 3), uint8."""
        world: Any = self.world
        return world.render(*args, **kwargs)

    def close(self) -> None:
        """Frees the world."""
        self.world.close()

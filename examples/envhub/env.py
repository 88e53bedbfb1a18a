"""An environment for LeRobot's EnvHub: the classes of a suite, one vector environment each.

hf upload ME/bidex-meta examples/envhub, then: lerobot.envs.factory.make_env("ME/bidex-meta", n_envs=8,
trust_remote_code=True). docs/hub.md lists what LeRobot gets.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Dict
from gymnasium.vector import VectorWrapper
from gymnasium.vector.utils import batch_space

from bidex_meta import Benchmark
from bidex_meta.errors import BidexError
from bidex_meta.world import World

SUITE = "MT4-v2"
"""The suite, unless the `task` of LeRobot's config names another."""
_HANDS = ("right_hand", "left_hand")


def make_env(n_envs: int = 1, use_async_envs: bool = False, cfg: Any = None) -> dict[str, dict[int, "LeRobotEnv"]]:
    """Return the vector environments of a suite's classes, each with `n_envs` environments: `{suite: {number: env}}`.

    Tasks, rules and rewards are those of the suite. `use_async_envs` has no effect, because a world steps its
    environments in threads. All classes have observations and actions of one size. Raises BidexError for an unknown
    suite, and for a suite that hides its goals.
    """
    benchmark = Benchmark(getattr(cfg, "task", None) or SUITE)
    suite = benchmark.suite
    if suite.kind != "multi-task":
        raise BidexError(f'Expected a suite that shows its goals, such as "MT4-v2", got {suite.name}.')
    worlds = []
    for entry in suite.classes:
        alone = replace(suite, classes=(entry,), observation="plain", task_id="class")
        worlds.append(Benchmark(alone).make_world(num_envs=n_envs, stagger=False))
    width = max(world.observation_size for world in worlds)
    envs = [LeRobotEnv(world, width, name) for world, name in zip(worlds, benchmark.train_classes, strict=True)]
    return {suite.name: dict(enumerate(envs))}


class LeRobotEnv(VectorWrapper):
    """The world of the class `name` as LeRobot's evaluation uses it; observations are padded with zeros to a width.

    `agent_pos` holds the hands, `environment_state` objects and goal. `info["final_info"]` has `is_success`.
    """

    def __init__(self, world: World, width: int, name: str) -> None:
        super().__init__(world.to_numpy())
        self.world = world
        self._name = name
        is_hand = np.zeros(width, dtype=bool)
        for group in world.observation_groups:
            if group.name in _HANDS:
                for columns in group.where:
                    is_hand[columns] = True
        self._is_hand = is_hand
        spaces = {}
        for name, count in (("agent_pos", is_hand.sum()), ("environment_state", (~is_hand).sum())):
            spaces[name] = Box(-np.inf, np.inf, (int(count),), np.float32)
        self.single_observation_space = Dict(spaces)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[dict[str, np.ndarray], dict]:
        """Start all episodes from the first of LeRobot's seeds, one per environment; its options do not apply."""
        if isinstance(seed, list):
            seed = seed[0]
        obs, info = self.env.reset(seed=seed)
        return self._split(obs), info

    def step(self, actions: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict]:
        """Take actions (n_envs, 52) in [-1, 1]; an environment whose episode ends begins the next one."""
        obs, reward, terminated, truncated, info = self.env.step(actions)
        if "final_info" in info:
            info["final_info"]["is_success"] = info["final_info"]["episode"]["success"].astype(bool)
        return self._split(obs), reward, terminated, truncated, info

    def call(self, name: str, *args: object, **kwargs: object) -> tuple[object, ...]:
        """Return what LeRobot asks of each environment: time limit, task, its description, or a picture."""
        if name == "_max_episode_steps":
            return (int(self.world.max_episode_steps[0]),) * self.num_envs
        if name == "task":
            return (self._name,) * self.num_envs
        if name == "task_description":
            return tuple(self.world.instructions())
        if name == "render":
            return tuple(self.env.render() or ())
        raise AttributeError(f"LeRobotEnv has no {name}")

    def get_attr(self, name: str) -> tuple[object, ...]:
        """Return an attribute of each environment; see `call`."""
        return self.call(name)

    def _split(self, obs: np.ndarray) -> dict[str, np.ndarray]:
        """Return the hands and the rest of observations (n_envs, d)."""
        padded = np.zeros((len(obs), len(self._is_hand)), dtype=np.float32)
        padded[:, : obs.shape[1]] = obs
        return {"agent_pos": padded[:, self._is_hand], "environment_state": padded[:, ~self._is_hand]}

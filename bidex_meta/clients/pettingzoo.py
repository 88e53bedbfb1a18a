"""A task class as PettingZoo's parallel environment, with hands, fingers or other units as agents.

Requires `pip install 'bidex-meta[marl]'`.
"""

from collections.abc import Mapping

import numpy as np
import torch
from gymnasium.spaces import Box, Space

from bidex_meta.clients.gymnasium_env import TaskEnv
from bidex_meta.clients.needs import extra
from bidex_meta.engine.health import dense
from bidex_meta.errors import BidexError, known_name, shortened
from bidex_meta.hands.units import Agents
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.world.agent_views import agent_views

with extra("marl"):
    from pettingzoo import ParallelEnv


class HandsEnv(ParallelEnv):
    """A single environment of a task class with several agents, which all get the same reward, termination and `info`.

    `agents` divides the hands among agents: `"hands"`, `"fingers"`, `"single"` (one agent for everything), a TOML file,
    or a mapping from each agent's name to its units, which are fingers and palms (docs/learners/multiagent.md). Other
    arguments are as in `TaskEnv`. Raises BidexError for an unknown task class or render mode, or a faulty `agents`.
    """

    metadata = {"name": "bidex_meta", "render_modes": ["rgb_array"], "render_fps": 60}  # noqa: RUF012  (PettingZoo's)

    def __init__(
        self, task: str, agents: Agents = "hands", render_mode: str | None = None, seed: int | None = None,
        device: str | torch.device = "cpu", touch: bool = False
    ) -> None:  # fmt: skip
        self._env = TaskEnv(task, render_mode, seed, device, touch)
        self.render_mode = render_mode
        whole = self._env.world.single_observation_space
        size = self._env.world.single_action_space.shape[0]
        views = agent_views(self._env.world.observation_groups, size, agents)
        self.possible_agents = [view.name for view in views]
        self.agents: list[str] = []
        self._columns = {view.name: np.array(view.columns) for view in views}
        self._actions = {view.name: np.array(view.actions) for view in views}
        self.observation_spaces: dict[str, Box] = {}
        self.action_spaces: dict[str, Box] = {}
        for view in views:
            columns = self._columns[view.name]
            self.observation_spaces[view.name] = Box(whole.low[columns], whole.high[columns], dtype=np.float32)
            self.action_spaces[view.name] = Box(-1.0, 1.0, self._actions[view.name].shape, np.float32)
        self.state_space = whole
        self._state = np.zeros(whole.shape, np.float32)

    def observation_space(self, agent: str) -> Space:
        """Return an agent's observation space, the same object each time."""
        return self.observation_spaces[known_name("agent", agent, self.possible_agents)]

    def action_space(self, agent: str) -> Space:
        """Return an agent's action space, the same object each time."""
        return self.action_spaces[known_name("agent", agent, self.possible_agents)]

    @checked_arguments
    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict[str, np.ndarray], dict]:
        """Start an episode; return observations by agent, and empty infos. A seed always gives the same episode.

        Options have no effect.
        """
        self._state, _ = self._env.reset(seed=seed)
        self.agents = list(self.possible_agents)
        return self._observations(), {name: {} for name in self.agents}

    @checked_arguments
    def step(self, actions: Mapping[str, object]) -> tuple[dict, dict, dict, dict, dict]:
        """Advance the environment by 1/60 s with one action per agent.

        An action is in [-1, 1]. Its entries are those actions of the world that the agent controls, in the world's
        order. Returns five dicts by agent: observations, rewards, terminated, truncated and infos (as in
        `TaskEnv.step`). After the end of the episode, further steps return empty dicts. BidexError is raised if an
        agent's action is missing or has another shape.
        """
        if not self.agents:
            return {}, {}, {}, {}, {}
        joint = np.zeros(sum(map(len, self._actions.values())), np.float32)
        for name in self.agents:
            expected = self.action_spaces[name].shape
            given = dense(actions.get(name), torch.device("cpu"))
            if given is None or given.shape != expected:
                if given is not None:
                    got = f"shape {tuple(given.shape)}"
                elif name in actions:
                    got = shortened(actions[name])
                else:
                    got = "nothing"
                raise BidexError(f"Expected an action of shape {expected} of agent {name}, got {got}.")
            joint[self._actions[name]] = given
        self._state, reward, terminated, truncated, info = self._env.step(joint)
        every = self.agents
        obs = self._observations()
        if terminated or truncated:
            self.agents = []
        rewards, ends, cuts = (dict.fromkeys(every, value) for value in (reward, terminated, truncated))
        return obs, rewards, ends, cuts, {name: dict(info) for name in every}

    def state(self) -> np.ndarray:
        """Return the full observation, for centralised critics."""
        return self._state.copy()

    def render(self) -> np.ndarray | None:
        """Return a picture (height, width, 3), uint8; None without a render mode."""
        return self._env.render()

    def close(self) -> None:
        """Free the world."""
        self._env.close()

    def _observations(self) -> dict[str, np.ndarray]:
        return {name: self._state[self._columns[name]] for name in self.agents}


parallel_env = HandsEnv  # the name that PettingZoo's packages use

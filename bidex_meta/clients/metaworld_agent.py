"""Agents between here and Meta-World: ours play in its evaluation, those written for it in ours.

The protocols have the same names and order of calls (``bidex_meta/agents.py``); what differs is that Meta-World hands
out NumPy arrays, tells nothing of rows that share a task, and calls ``reset`` before and during evaluation alone.
"""

from collections import namedtuple
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bidex_meta.agents import Agent, Timestep

MetaWorldTimestep = namedtuple("MetaWorldTimestep", Timestep._fields[:6])
"""The six entries of Meta-World's own, for agents that unpack them."""


class ForMetaWorld:
    """One of our agents as ``metaworld.evaluation`` takes it: NumPy arrays in and out.

    Args:
        agent: An Agent, for ``evaluation``; a MetaLearningAgent, for ``metalearning_evaluation``.
        device: Where the agent is.
        task_of_row: Which rows play the same task, numbers from 0 on; None: each has one of its own.
    """

    def __init__(self, agent: Agent, device: str | torch.device = "cpu", task_of_row: Any = None):
        self._agent: Any = agent
        self._device = torch.device(device)
        self._task_of_row = None if task_of_row is None else self._tensor(np.asarray(task_of_row, np.int64))
        self._begins = True

    def eval_action(self, observations: np.ndarray) -> np.ndarray:
        """Actions (num_envs, a), float32, for observations (num_envs, d); no exploration."""
        return _array(self._agent.eval_action(self._tensor(observations)))

    def reset(self, env_mask: np.ndarray) -> None:
        """New episodes in the rows of a bool mask (num_envs,), which may be empty."""
        if np.any(env_mask):
            self._agent.reset(self._tensor(env_mask))

    def init(self) -> None:
        """Back to what was meta-learned."""
        if hasattr(self._agent, "assign"):
            self._agent.assign(self._task_of_row)
        self._agent.init()
        self._begins = True

    def adapt_action(self, observations: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
        """Exploring actions (num_envs, a), float32, and the policy's other outputs as arrays."""
        obs = self._tensor(observations)
        if self._begins:  # Meta-World resets the environments here, and does not say so
            self._agent.reset(torch.ones(len(obs), dtype=torch.bool, device=self._device))
            self._begins = False
        action, outputs = self._agent.adapt_action(obs)
        return _array(action), {name: _array(value) for name, value in outputs.items()}

    def step(self, timestep: Any) -> None:
        """Takes in one transition of every row: Meta-World's Timestep, or its first six entries."""
        obs, action, reward, terminated, truncated, outputs = timestep[:6]
        tensors = [self._tensor(value) for value in (obs, action, reward, terminated, truncated)]
        self._agent.step(Timestep._make([*tensors, {k: self._tensor(v) for k, v in outputs.items()}, None, None]))
        self.reset(np.logical_or(terminated, truncated))  # the rows go on with their next episodes

    def adapt(self) -> None:
        """Learns from the transitions since the last ``adapt`` or ``init``."""
        self._agent.adapt()
        self._begins = True

    def _tensor(self, value: Any) -> Any:
        """An array as a tensor, numbers with a fraction as float32; anything else as it is."""
        if not isinstance(value, np.ndarray):
            return value
        tensor = torch.from_numpy(value.copy())  # an environment may write into its array again
        return tensor.to(self._device, torch.float32 if tensor.is_floating_point() else tensor.dtype)


class FromMetaWorld:
    """An agent written for Meta-World's ``metalearning_evaluation`` as ``meta_evaluate`` takes it.

    Where Meta-World starts a row's next episode, ours leaves it frozen until all rows have ended. The agent sees such a
    row go on without reward and without an end, as it sees Meta-World's rows that stop in the middle of an episode.

    Args:
        agent: Takes and returns NumPy arrays.
    """

    def __init__(self, agent: Any):
        self._agent = agent
        self._begun: Tensor | None = None
        self._over: Tensor | None = None

    def eval_action(self, obs: Tensor) -> Tensor:
        """Actions (num_envs, a) for observations (num_envs, d)."""
        if self._begun is not None:
            self._agent.reset(_array(self._begun))
            self._begun = None
        return torch.as_tensor(self._agent.eval_action(_array(obs)), device=obs.device)

    def reset(self, env_mask: Tensor) -> None:
        """New episodes in the rows of a bool mask (num_envs,); the agent is told if they are evaluation's."""
        self._begun = env_mask
        self._over = ~env_mask

    def init(self) -> None:
        """Back to what was meta-learned."""
        self._agent.init()

    def adapt_action(self, obs: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """Exploring actions (num_envs, a), and the agent's other outputs as it gave them."""
        self._begun = None
        action, outputs = self._agent.adapt_action(_array(obs))
        return torch.as_tensor(action, device=obs.device), outputs

    def step(self, timestep: Timestep) -> None:
        """Takes in one transition of every row."""
        assert self._over is not None  # reset comes first
        running = ~self._over
        ended = (timestep.terminated | timestep.truncated) & running
        reward = torch.where(running, timestep.reward, torch.zeros_like(timestep.reward))
        flags = (_array(timestep.terminated & running), _array(timestep.truncated & running))
        told = (_array(timestep.observation), _array(timestep.action), _array(reward), *flags)
        self._agent.step(MetaWorldTimestep(*told, timestep.aux_policy_outputs))
        self._over = self._over | ended

    def adapt(self) -> None:
        """Learns from the transitions since the last ``adapt`` or ``init``."""
        self._agent.adapt()


def _array(value: Any) -> Any:
    return value.detach().cpu().numpy() if isinstance(value, Tensor) else value

"""Adapters of agents and worlds between this benchmark's and Meta-World's evaluation (docs/metaworld.md).

The agents' protocols have the same names and order of calls (``bidex_meta/agents.py``). However, Meta-World uses NumPy
arrays, does not say which environments share a task, and calls ``reset`` only before and during evaluation.
"""

from collections import namedtuple
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from torch import Tensor

from bidex_meta.agents import Agent, MetaLearningAgent, Timestep
from bidex_meta.engine.choice import checked_device
from bidex_meta.engine.health import dense
from bidex_meta.errors import BidexError, shortened
from bidex_meta.evaluation.meta_test import checked_outputs
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.validation import real_numbers, true_or_false
from bidex_meta.world.contract import Info, Options, PooledWorld

MetaWorldTimestep = namedtuple("MetaWorldTimestep", Timestep._fields[:6])
"""The six entries of Meta-World's own Timestep, for agents that unpack it."""


class ForMetaWorld:
    """Adapts one of our agents to ``metaworld.evaluation``, which passes and expects NumPy arrays.

    ``agent`` is an Agent for ``evaluation``, or a MetaLearningAgent for ``metalearning_evaluation``. ``task_of_row``
    holds each environment's task number (0, 1, ...); if it is None, each environment has its own task.
    """

    @checked_arguments
    def __init__(
        self, agent: Agent, device: str | torch.device = "cpu", task_of_row: Sequence[int] | np.ndarray | None = None
    ):
        self._agent = cast(MetaLearningAgent, agent)
        self._device = checked_device(device)
        if task_of_row is None:
            self._task_of_row = None
        else:
            self._task_of_row = self._tensor(real_numbers("task_of_row", task_of_row, 1).astype(np.int64))
        self._begins = True

    def eval_action(self, observations: np.ndarray) -> np.ndarray:
        """Return actions (num_envs, a), float32, for observations (num_envs, d), without exploration."""
        return _array(self._agent.eval_action(self._tensor(observations)))

    def reset(self, env_mask: np.ndarray) -> None:
        """Start new episodes in the environments of a bool mask (num_envs,), which may be empty."""
        mask = self._tensor(env_mask)
        if mask.dtype != torch.bool or mask.dim() != 1:
            raise BidexError(f"env_mask: expected bool of shape (num_envs,), got {shortened(env_mask)}.")
        if bool(mask.any()):
            self._agent.reset(mask)

    def init(self) -> None:
        """Reset the agent to its meta-learned state."""
        if hasattr(self._agent, "assign"):
            self._agent.assign(self._task_of_row)
        self._agent.init()
        self._begins = True

    def adapt_action(self, observations: np.ndarray) -> tuple[np.ndarray, Info]:
        """Return exploring actions (num_envs, a), float32, and the policy's other outputs as arrays."""
        obs = self._tensor(observations)
        if self._begins:  # Meta-World resets the environments here without calling reset of the agent
            self._agent.reset(torch.ones(len(obs), dtype=torch.bool, device=self._device))
            self._begins = False
        action, outputs = checked_outputs(self._agent, self._agent.adapt_action(obs))
        return _array(action), {k: _array(v) if isinstance(v, Tensor) else v for k, v in outputs.items()}

    def step(self, timestep: tuple) -> None:
        """Pass one transition of every environment to the agent.

        ``timestep`` is Meta-World's Timestep, or a tuple of its first six entries.
        """
        obs, action, reward, terminated, truncated, outputs = timestep[:6]
        tensors = [self._tensor(value) for value in (obs, action, reward, terminated, truncated)]
        outputs = {k: self._tensor(v) if isinstance(v, np.ndarray) else v for k, v in outputs.items()}
        self._agent.step(Timestep._make([*tensors, outputs, None, None]))
        self.reset(np.logical_or(terminated, truncated))  # ended environments start their next episodes

    def adapt(self) -> None:
        """Learn from the transitions since the last ``adapt`` or ``init``."""
        self._agent.adapt()
        self._begins = True

    def _tensor(self, value: np.ndarray) -> Tensor:
        tensor = dense(value, self._device)
        if tensor is None:
            raise BidexError(f"ForMetaWorld: expected an array of numbers, got {shortened(value)}.")
        # The observation is copied, because an environment may write into its array again.
        return tensor.to(torch.float32 if tensor.is_floating_point() else tensor.dtype, copy=True)


class FromMetaWorld:
    """Adapts an agent that was written for Meta-World's ``metalearning_evaluation`` to ``meta_evaluate``.

    When an episode ends, Meta-World starts the environment's next episode. Our worlds freeze the environment until all
    episodes have ended, and the agent sees the frozen episode continue without reward and without an end.
    """

    @checked_arguments
    def __init__(self, agent: Agent):
        self._agent: Any = agent
        self._begun: Tensor | None = None
        self._over: Tensor | None = None

    def eval_action(self, obs: Tensor) -> Tensor:
        """Return actions (num_envs, a) for observations (num_envs, d)."""
        if self._begun is not None:
            self._agent.reset(_array(self._begun))
            self._begun = None
        return torch.as_tensor(self._agent.eval_action(_array(obs)), device=obs.device)

    def reset(self, env_mask: Tensor) -> None:
        """Start new episodes in a bool mask (num_envs,) of environments; only resets for evaluation reach the agent."""
        self._begun = env_mask
        self._over = ~env_mask

    def init(self) -> None:
        """Reset the agent to its meta-learned state."""
        self._agent.init()

    def adapt_action(self, obs: Tensor) -> tuple[Tensor, Info]:
        """Return exploring actions (num_envs, a), and the agent's other outputs unchanged."""
        self._begun = None
        action, outputs = checked_outputs(self._agent, self._agent.adapt_action(_array(obs)))
        return torch.as_tensor(action, device=obs.device), outputs

    def step(self, timestep: Timestep) -> None:
        """Pass one transition of every environment to the agent."""
        assert self._over is not None  # reset is called first
        running = ~self._over
        ended = (timestep.terminated | timestep.truncated) & running
        reward = torch.where(running, timestep.reward, torch.zeros_like(timestep.reward))
        flags = (_array(timestep.terminated & running), _array(timestep.truncated & running))
        arrays = (_array(timestep.observation), _array(timestep.action), _array(reward), *flags)
        self._agent.step(MetaWorldTimestep(*arrays, timestep.aux_policy_outputs))
        self._over = self._over | ended

    def adapt(self) -> None:
        """Learn from the transitions since the last ``adapt`` or ``init``."""
        self._agent.adapt()


class MetaWorldEnvs(VectorEnv):
    """Vector environment that gives one of our worlds the interface that Meta-World's evaluation expects.

    It exchanges NumPy arrays, resets an environment in the step in which its episode ends (Gymnasium's mode SAME_STEP),
    and has the attributes and methods that Meta-World calls. Raises BidexError unless the world's own autoreset mode is
    DISABLED, because success may end episodes and this class then starts new episodes.
    """

    @checked_arguments
    def __init__(self, world: PooledWorld):
        if world.metadata["autoreset_mode"] != AutoresetMode.DISABLED:
            raise BidexError("Expected a world that does not reset by itself. Make it with autoreset_mode='DISABLED'.")
        self.world = world
        self.num_envs = world.num_envs
        self.metadata = {**world.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}
        self.single_observation_space = world.single_observation_space
        self.observation_space = world.observation_space
        self.single_action_space = world.single_action_space
        self.action_space = world.action_space
        self.terminate_on_success = False
        self.task_name = [world.task_names[slot] for slot in world.task_id.tolist()]
        self._pools = world.pools
        self._samples = 0
        self._returns = torch.zeros(self.num_envs, dtype=torch.float64, device=world.task_id.device)
        self._lengths = torch.zeros_like(world.task_id)

    @checked_arguments
    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[np.ndarray, Info]:
        """Start an episode in every environment and return observations (num_envs, d). There are no options."""
        if options:
            raise BidexError(f"MetaWorldEnvs: expected reset() without options, got {shortened(options)}.")
        obs, _ = self.world.reset(seed=seed)
        self._returns.zero_()
        self._lengths.zero_()
        return obs.cpu().numpy(), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]:
        """Advance every environment by actions (num_envs, a) in [-1, 1].

        Returns observations (num_envs, d), rewards, terminated, truncated and info. If an environment's episode ended,
        its observation is the first one of the next episode. ``info`` has ``success``, ``final_obs`` and
        ``final_info``, which has ``success`` and, in ``episode``, the return ``r`` and the length ``l``. If the suite
        judges success at the end of an episode, ``success`` is false before the last step, and
        ``terminate_on_success`` has no effect.
        """
        obs, reward, terminated, truncated, info = self.world.step(actions)  # type: ignore[arg-type]
        success = info["success"]
        if self.world.success_at_end:
            success = success & (terminated | truncated)
        if self.terminate_on_success:
            terminated = terminated | success
            truncated = truncated & ~success
        ended = terminated | truncated
        self._returns += reward.double()
        self._lengths += 1
        episode = {"r": self._returns.cpu().numpy().copy(), "l": self._lengths.cpu().numpy().copy()}
        ended_info: Info = {"success": success.cpu().numpy(), "final_obs": obs.cpu().numpy().copy()}
        ended_info["final_info"] = {"episode": episode, "success": ended_info["success"]}
        ended_info |= {"_final_info": ended.cpu().numpy(), "_final_obs": ended.cpu().numpy()}
        if bool(ended.any()):
            obs, _ = self.world.reset(options={"reset_mask": ended})
            self._returns.masked_fill_(ended, 0.0)
            self._lengths.masked_fill_(ended, 0)
        arrays = (value.cpu().numpy() for value in (obs, reward, terminated, truncated))
        return (*arrays, ended_info)  # type: ignore[return-value]

    def toggle_terminate_on_success(self, on: bool) -> None:
        """Choose whether an episode ends at its first success."""
        self.terminate_on_success = true_or_false("on", on)

    def toggle_sample_tasks_on_reset(self, on: bool) -> None:
        """Raise BidexError when switched on, because environments keep their tasks until ``sample_tasks`` is called."""
        if on:
            raise BidexError("Environments keep their tasks until sample_tasks(), as Meta-World's evaluation has it.")

    def sample_tasks(self) -> None:
        """Choose the next tasks in the order of each pool, one per environment; they apply from the next reset on.

        Environment j of a class plays task j of its pool, so the pools are turned. They keep all their tasks.
        """
        chosen = {}
        for name, pool, rows in zip(self.world.task_names, self._pools, self.world.slot_env_ids, strict=True):
            chosen[name] = np.roll(pool, -self._samples * (rows.stop - rows.start), axis=0)
        self.world.set_tasks(chosen)
        self._samples += 1

    def get_attr(self, name: str) -> tuple[object, ...]:
        """Return the value of an attribute for each environment."""
        value = getattr(self, name)
        if name == "task_name":
            return tuple(value)
        return (value,) * self.num_envs

    def call(self, name: str, *args: object, **kwargs: object) -> tuple[object, ...]:
        """Call a method (or read an attribute) once and return the result for each environment."""
        value = getattr(self, name)
        if callable(value):
            return (value(*args, **kwargs),) * self.num_envs
        return self.get_attr(name)

    def set_attr(self, name: str, values: object) -> None:
        """Set an attribute of this vector environment."""
        setattr(self, name, values)

    def close_extras(self, **kwargs: object) -> None:
        """Free the world."""
        self.world.close()


def _array(value: Tensor) -> np.ndarray:
    return value.detach().cpu().numpy()

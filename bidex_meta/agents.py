"""Protocols of agents, with Meta-World's method names and call order, so that both libraries can evaluate agents."""

from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor


class Agent(Protocol):
    """An agent that can be evaluated."""

    def eval_action(self, obs: Tensor) -> Tensor:
        """Return actions ``(num_envs, action)`` in [-1, 1], without exploration, for ``(num_envs, observation)``."""
        ...

    def reset(self, env_mask: Tensor) -> None:
        """Forget the last episode of the environments marked in ``env_mask``, bool ``(num_envs,)``.

        A new episode begins in these environments.
        """


class Timestep(NamedTuple):
    """One transition of every environment, as an adapting agent receives it.

    The first six entries are Meta-World's. In Meta-World's evaluation the other entries are None.
    """

    observation: Tensor
    """Observations that the actions were chosen for, ``(num_envs, observation)``."""
    action: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    """Bool ``(num_envs,)``: the episode was cut off by its time limit, or by the agent's limit
    (``max_adapt_steps``)."""
    aux_policy_outputs: dict[str, Tensor]
    """The policy's outputs other than actions, as returned by ``adapt_action``."""
    next_observation: Tensor | None = None
    """Observations after the transition, in the same episode, ``(num_envs, observation)``."""
    valid: Tensor | None = None
    """Bool ``(num_envs,)``: False for environments that are frozen after their episode, or whose physics broke."""

    @property
    def valid_mask(self) -> Tensor:
        """Return ``valid``; if it is None, as in Meta-World's evaluation, all environments are valid."""
        if self.valid is None:
            return torch.ones_like(self.terminated, dtype=torch.bool)
        return self.valid


class MetaLearningAgent(Agent, Protocol):
    """An agent that adapts to tasks.

    The methods are called in this order: first ``assign`` (only in our evaluation) and ``init``; then, for each shot,
    ``reset`` of all environments, ``adapt_action`` and ``step`` until every environment has played its episodes, and
    ``adapt``. Evaluations before, between and after shots call ``reset`` and ``eval_action``. An agent that learns
    within an episode also has ``observe(timestep)``, which these evaluations call after each step, so that the agent
    sees the reward.
    """

    def assign(self, task_of_row: Tensor | None) -> None:
        """Receive the index of each environment's task, int64 ``(num_envs,)``; equal indices mean the same task.

        None means that each environment has its own task. This is also the case in Meta-World's evaluation, which does
        not call this method.
        """

    def init(self) -> None:
        """Return to the meta-learned state; forget all adaptation and its data."""

    def adapt_action(self, obs: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return exploring actions ``(num_envs, action)``, and the policy's other outputs by name.

        The evaluation passes these outputs back to ``step``, as ``Timestep.aux_policy_outputs``.
        """
        ...

    def step(self, timestep: Timestep) -> None:
        """Receive one transition of every environment."""

    def adapt(self) -> None:
        """Learn from all transitions since the last ``adapt`` or ``init``."""


@runtime_checkable
class TrialAgent(Protocol):
    """An agent of your own that learns about a task while it acts; ``meta_test`` needs only these methods.

    A trial is a few episodes of one task in each of N environments, with rewards shown in all of them. ``reset`` begins
    trials of other tasks; the size of its mask is N. Then each step calls ``act`` and ``observe``. The next episode of
    a trial begins without a call, after ``terminated`` or ``truncated``. If ``valid`` is False, learn nothing from the
    environment: its episode is over and the environment waits for the others, or its physics broke. Broken physics ends
    the episode too: ``truncated`` is then true although ``valid`` is False. One of the two flags is true once per
    episode. Tensors are on the device of the world.

    ``copy.deepcopy`` must copy what the agent has learned: copies act in the evaluation episodes, and the agent itself
    learns only from exploring episodes.
    """

    def reset(self, env_mask: Tensor) -> None:
        """Begin a trial of another task in the environments marked in ``env_mask``, bool ``(N,)``.

        The agent must forget the previous trials of these environments.
        """

    def act(self, obs: Tensor) -> Tensor:
        """Return actions ``(N, action)`` in [-1, 1] for observations ``(N, observation)``."""
        ...

    def observe(self, timestep: Timestep) -> None:
        """Receive the transition that the last actions led to, with reward ``(N,)``."""

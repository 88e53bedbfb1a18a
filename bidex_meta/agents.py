"""The interface of agents to an evaluation. Names and order of calls are Meta-World's, so that an agent serves both."""

from typing import Any, NamedTuple, Protocol

from torch import Tensor


class Agent(Protocol):
    """A policy that an evaluation can judge."""

    def eval_action(self, obs: Tensor) -> Tensor:
        """Return actions ``(num_envs, action)`` in [-1, 1], without exploration.

        ``obs`` are the observations ``(num_envs, observation)``.
        """
        ...

    def reset(self, env_mask: Tensor) -> None:
        """Forget the episode in the environments of a mask, bool ``(num_envs,)``: a new one begins there."""


class Timestep(NamedTuple):
    """One transition of every environment, as an adapting agent gets it.

    The first six are Meta-World's; from its evaluation the others are missing (None).
    """

    observation: Tensor
    """Observations the actions were chosen for, ``(num_envs, observation)``."""
    action: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    """Bool ``(num_envs,)``: the episode was cut, by its time limit or since it was long enough to adapt."""
    aux_policy_outputs: dict[str, Tensor]
    """What ``adapt_action`` returned beside the actions."""
    next_observation: Tensor | None = None
    """Observations the transition led to, of the same episode, ``(num_envs, observation)``."""
    valid: Tensor | None = None
    """Bool ``(num_envs,)``: False in rows that are frozen, since their episode is over, or where physics broke."""


class MetaLearningAgent(Agent, Protocol):
    """An agent that adapts to the tasks it is put into.

    The order: ``assign`` (ours alone), ``init``; then for each shot ``reset`` of all environments, ``adapt_action`` and
    ``step`` until each has played its episodes, ``adapt``; in between and at the end ``reset`` and ``eval_action``.
    """

    def assign(self, task_of_row: Tensor | None) -> None:
        """Take which environments play the same task and share what they learn: int64 ``(num_envs,)``, from 0 on.

        None: each environment has its own task, as in Meta-World's evaluation, which does not call this.
        """

    def init(self) -> None:
        """Return to the meta-learned state: forget all adaptation and its data."""

    def adapt_action(self, obs: Tensor) -> tuple[Tensor, dict[str, Any]]:
        """Return exploring actions ``(num_envs, action)``, and the policy's outputs that ``step`` is given back."""
        ...

    def step(self, timestep: Timestep) -> None:
        """Take in one transition of every environment."""

    def adapt(self) -> None:
        """Learn from all transitions since the last ``adapt`` or ``init``."""

"""Adapter that gives a user's own agent (``TrialAgent``) the methods that the meta-test calls."""

import copy
from typing import TypeVar

import torch
from torch import Tensor

from bidex_meta.agents import Agent, Timestep, TrialAgent
from bidex_meta.errors import BidexError, one_line

_Any = TypeVar("_Any", bound=TrialAgent | Agent)


def adapting(agent: TrialAgent | Agent) -> Agent:
    """Return an agent that has the methods called by the meta-test.

    The agent is copied, so that splits do not influence each other, and a ``TrialAgent`` is wrapped in an adapter.
    """
    if isinstance(agent, TrialAgent) and not hasattr(agent, "adapt_action"):
        return AdaptingTrialAgent(_copied(agent))
    return _copied(agent)  # pyright: ignore[reportReturnType]


class AdaptingTrialAgent:
    """Adapter that makes a ``MetaLearningAgent`` from a user's ``TrialAgent``.

    The agent itself plays the exploring episodes and learns from them. Each evaluation is played by a copy of the
    agent, so that evaluations do not change what the agent has learned.
    """

    def __init__(self, agent: TrialAgent) -> None:
        self._agent = agent
        self._playing = agent
        self._is_fresh = True

    def assign(self, task_of_row: Tensor | None) -> None:
        """Do nothing: each environment learns from its own episodes."""

    def init(self) -> None:
        """Make the next ``reset`` restart the trials in all environments, so that the agent forgets what it learned."""
        self._is_fresh = True

    def reset(self, env_mask: Tensor) -> None:
        """Begin episodes in the environments of a mask (N,)."""
        if self._is_fresh:
            self._agent.reset(torch.ones_like(env_mask))
            self._is_fresh = False
        self._playing = _copied(self._agent)

    def adapt_action(self, obs: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the agent's actions (N, a) for observations (N, d)."""
        return self._agent.act(obs), {}

    def step(self, timestep: Timestep) -> None:
        """Show the agent a transition of an exploring episode."""
        self._agent.observe(timestep)

    def adapt(self) -> None:
        """Do nothing: the agent has learned from each transition."""

    def eval_action(self, obs: Tensor) -> Tensor:
        """Return actions (N, a) for observations (N, d), from the copy of the agent that plays the evaluation."""
        return self._playing.act(obs)

    def observe(self, timestep: Timestep) -> None:
        """Show a transition of an evaluation episode to the copy of the agent that plays the evaluation."""
        self._playing.observe(timestep)


def _copied(agent: _Any) -> _Any:
    """Return a deep copy of an agent; raise BidexError if it holds something that cannot be copied."""
    try:
        return copy.deepcopy(agent)
    except (TypeError, RuntimeError) as error:
        raise BidexError(
            f"Expected an agent that copy.deepcopy can copy, got a {type(agent).__name__}: {one_line(error)}. Keep no "
            "open files, locks or tensors with a graph in it, or write its __deepcopy__."
        ) from None

"""Teachers: policies and scripts that say which actions they would take in the states of a world.

These actions are labels for imitation; another policy may act in the world.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from bidex_meta.agents import Agent
from bidex_meta.witness.demonstrators import Scripted
from bidex_meta.world.contract import PrivilegedWorld, VectorWorld


@dataclass(frozen=True)
class Tutor:
    """A policy that teaches in some environments of a world.

    ``rows`` (k,), int64, are these environments. The policy reads the first ``width`` entries of an observation and
    then ``more`` (k, m), such as the padding and the task id of the suite that it was trained on. A policy of one class
    reads neither. ``source`` has the name of the learner that made the policy (``algo``) and the state from which this
    learner loads it again (``policy``). It is None for a policy that was not loaded from a run. ``trained`` are the
    folder of this run and its environment steps.
    """

    policy: Agent
    rows: Tensor
    width: int
    more: Tensor | None = None
    source: Mapping[str, Any] | None = None
    trained: tuple[str, int] | None = None

    def eval_action(self, obs: Tensor) -> Tensor:
        """Return the policy's actions (k, a) for the observations (N, d) of all environments."""
        seen = obs[self.rows, : self.width]
        if self.more is not None:
            seen = torch.cat([seen, self.more], dim=1)
        return self.policy.eval_action(seen)


class Teachers:
    """An agent that returns the actions of teachers, which label the states of a world's environments for imitation.

    Use it like any agent: call ``eval_action`` in every step and ``reset`` when episodes begin. Scripts (``scripted``)
    label the environments in ``scripted_rows``, bool (N,). Each policy in ``tutors`` labels its own environments.
    ``privileged`` is a world that shows the policies the goals that it hides in its observations. The attribute
    ``known``, bool (N,), says which environments have a teacher.
    """

    def __init__(
        self,
        world: VectorWorld,
        tutors: Sequence[Tutor] = (),
        scripted: Scripted | None = None,
        scripted_rows: Tensor | None = None,
        privileged: PrivilegedWorld | None = None,
    ) -> None:
        self.privileged = privileged
        self.tutors = tutors
        self._scripted = scripted
        self._shape = world.action_space.shape
        self.known = torch.zeros(world.num_envs, dtype=torch.bool, device=world.device)
        if scripted_rows is not None:
            self.known |= scripted_rows
        for tutor in tutors:
            self.known[tutor.rows] = True

    @property
    def follow(self) -> bool:
        """Return whether a teacher must follow each episode from its start, because it is a script.

        Such a teacher cannot begin in the middle of an episode.
        """
        return self._scripted is not None

    def eval_action(self, obs: Tensor) -> Tensor:
        """Return the teachers' actions (N, a), in [-1, 1], for observations (N, d).

        The actions are zero in environments without a teacher.
        """
        if self._scripted is None:
            labels = obs.new_zeros(self._shape)
        else:
            labels = self._scripted.eval_action(obs)
        if self.privileged is not None and self.tutors:
            obs = self.privileged.with_goals(obs)
        for tutor in self.tutors:
            actions = tutor.eval_action(obs)
            labels[tutor.rows, : actions.shape[1]] = actions
        return labels

    def reset(self, env_mask: Tensor) -> None:
        """Tell the teachers that an episode begins in the environments that ``env_mask`` selects, bool (N,)."""
        if self._scripted is not None:
            self._scripted.reset(env_mask)
        for tutor in self.tutors:
            tutor.policy.reset(env_mask[tutor.rows])

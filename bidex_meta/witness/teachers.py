"""Teachers: policies and scripts that label the states of a world with actions, whichever policy acts there."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from bidex_meta.agents import Agent
from bidex_meta.witness.demonstrators import Scripted
from bidex_meta.world.contract import PrivilegedWorld, VectorWorld


@dataclass(frozen=True)
class Tutor:
    """A policy, the environments that it labels, int64 (k,), and the number of observation entries that it reads.

    A policy of one class reads only the first entries of a suite's observation, which padding and the task id follow.
    """

    policy: Agent
    rows: Tensor
    width: int


class Teachers:
    """Labels the states of a world's environments with actions.

    Use it like an agent: call ``eval_action`` in every step and ``reset`` when episodes begin. ``known``: the
    environments that have a teacher, bool (N,). ``scripted`` labels the environments in ``scripted_rows``, bool (N,);
    each of the ``tutors`` labels its own environments. ``privileged`` shows the tutors the goals that the world hides.
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
        self._tutors = tutors
        self._scripted = scripted
        self._shape = world.action_space.shape
        self.known = torch.zeros(world.num_envs, dtype=torch.bool, device=world.device)
        if scripted_rows is not None:
            self.known |= scripted_rows
        for tutor in tutors:
            self.known[tutor.rows] = True

    @property
    def follow(self) -> bool:
        """Return whether a teacher depends on more than the state: a script must follow each episode from its start."""
        return self._scripted is not None

    def eval_action(self, obs: Tensor) -> Tensor:
        """Return the teachers' actions, (N, a) in [-1, 1], for observations (N, d); zeros outside ``known``."""
        if self._scripted is None:
            labels = obs.new_zeros(self._shape)
        else:
            labels = self._scripted.eval_action(obs)
        if self.privileged is not None and self._tutors:
            obs = self.privileged.with_goals(obs)
        for tutor in self._tutors:
            actions = tutor.policy.eval_action(obs[tutor.rows, : tutor.width])
            labels[tutor.rows, : actions.shape[1]] = actions
        return labels

    def reset(self, env_mask: Tensor) -> None:
        """Restart the teachers in the environments of a mask, which are at the start of an episode."""
        if self._scripted is not None:
            self._scripted.reset(env_mask)
        for tutor in self._tutors:
            tutor.policy.reset(env_mask[tutor.rows])

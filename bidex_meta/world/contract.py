"""The contract of batched worlds: learners, evaluation and clients may rely on this page and on nothing else.

``tests/test_contract.py`` checks every world against it. A world has N environments, each of one slot (a task class of
the suite; MT1: a task of its class). All tensors are on ``device``. A reset or step returns tensors that the caller
owns: no later step changes them. Changes to them or to the given action do not affect the world.

Modes (``metadata["autoreset_mode"]``): in SAME_STEP (training) an environment that ends starts its next episode within
the step; the observation returned is already that of the new episode, ``info["final_obs"]`` has the last one. In
DISABLED (evaluation, meta-learning) an ended environment is frozen: it may be stepped, keeps its observation and its
flags and gets reward 0, until a ``reset`` whose ``reset_mask`` names it. NEXT_STEP, which Gymnasium's tools expect and
none of our learners uses, lies between them: the step after its end starts an environment's next episode, whatever the
action, with reward 0.

``info`` of a reset is empty (except ``pixels``); ``info`` of a step describes the transition just made:

=====================  ====================  ===========================================================================
key                    shape, type           meaning
=====================  ====================  ===========================================================================
success                (N,), bool            the goal is met in this state; where success counts at the end, for the
                                             last 15 steps
unstable               (N,), bool            physics broke, or the action was not finite: reward 0, truncated, the
                                             transition teaches nothing; never in a frozen environment
reward_unscaled        (N,), float32         reward before the suite's scale of the class; 0 in a frozen environment
final_obs              (N, d), float32       the observation that the transition led to; of an unstable one the last
                                             before it
_final_obs             (N,), bool            environments that ended in this step: there ``final_obs`` is the last of
                                             the episode; elsewhere it is the observation that the step returns
running                dict of (N,)          r (return, float32), l (length, int64), success (by the suite's
                                             rule, bool), unscaled (return, float32), of the episode so far
episode_mask           (N,), bool            environments whose episode ended and counts (shortened first ones do
                                             not)
=====================  ====================  ===========================================================================

The world decides what a successful episode is, by the suite's rule, and reports it in ``running["success"]``: the entry
of an episode's last step is the success of the episode, and the entry of any other step is its success if it is cut
there. Nothing else decides: success at several steps must not be combined, because where success counts at the end an
episode can lose it again.

For users of Gymnasium our worlds add its ``episode``, ``_episode``, ``final_info`` and ``_final_info``
(``episodes.py``) when an environment ended, and on the warp engine, which would have to wait for the answer, in every
step: zero outside their masks. ``solved`` says whether the goal is met in this state, whatever the rule. A world may
add keys like these, ``reward_terms`` and ``pixels``; learners may not rely on them.

Shortened first episodes: in SAME_STEP mode the first episode of each environment, after the first reset and after each
reset with a seed, may begin at a random elapsed step, so that environments do not end together; the time limit counts
from there. A world that does so has an attribute ``stagger``, which may be set: it decides about the next such reset.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from gymnasium.spaces import Box
from torch import Tensor

Info = dict[str, Any]
"""Report of a step; the keys are above."""
Options = dict[str, Any]
"""Options of a reset."""
State = dict[str, Any]
"""Tensors and plain values, nested, as a checkpoint holds them."""
Step = tuple[Tensor, Tensor, Tensor, Tensor, Info]
"""Observations, rewards, terminated, truncated, info."""


@dataclass(frozen=True)
class ObservationGroup:
    """Entries of an observation that have the same kind in every environment of a world."""

    name: str
    """``right_hand``, ``left_hand``, ``object`` (the rest), ``goal`` (zeros where a suite hides it), ``padding``,
    ``task`` where slots differ (in MT4: padding to three classes, the second egg to one), ``task_id`` (one-hot), or
    ``last_step`` (in worlds of trials: the last action, the last reward, and 1 if an episode ended).
    Worlds without such parts have ``state``. Other classes may have other groups: in ML4 the two splits differ."""
    where: tuple[slice, ...]
    """Index ranges in ascending order, none next to another."""

    @property
    def size(self) -> int:
        """Number of entries."""
        return sum(part.stop - part.start for part in self.where)


def plain_groups(size: int, num_id_columns: int) -> tuple[ObservationGroup, ...]:
    """Return the groups of a world without parts: ``state``, and ``task_id`` for the last ``num_id_columns``."""
    groups = (("state", slice(0, size - num_id_columns)), ("task_id", slice(size - num_id_columns, size)))
    return tuple(ObservationGroup(name, (where,)) for name, where in groups if where.stop > where.start)


@runtime_checkable
class VectorWorld(Protocol):
    """N environments that are stepped together; each belongs to one of ``num_tasks`` slots."""

    single_observation_space: Box
    """Shape (d,), float32; ``observation_space`` (N, d)."""
    single_action_space: Box
    """Shape (a,), within [-1, 1]; ``action_space`` (N, a)."""
    observation_space: Box
    action_space: Box
    num_envs: int
    device: torch.device
    num_tasks: int
    task_id: Tensor
    """Slot of each environment, ascending, int64 (N,)."""
    task_names: list[str]
    """Names of the slots."""
    gammas: tuple[float | None, ...]
    """Discount per step that learners shall take for each slot; None: their own."""
    num_id_columns: int
    """Trailing entries of an observation that are the one-hot of the slot: ``num_tasks`` or 0."""
    observation_groups: tuple[ObservationGroup, ...]
    """The named parts of an observation, in the order of their first entries; each entry is in one."""
    metadata: dict[str, Any]
    """Holds ``autoreset_mode``, gymnasium's SAME_STEP, NEXT_STEP or DISABLED."""

    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[Tensor, Info]:
        """Start episodes; return observations (N, d), float32, and an empty info.

        Args:
            seed: Restarts all draws: equal seeds and actions give equal trajectories. None continues with the old
                seed's next episodes.
            options: ``reset_mask``: environments to start, bool (N,); others stay as they are. All by default.

        Raises BidexError for another option, a seed below 0, or a seed with a partial mask.
        """
        ...

    def step(self, action: Tensor, /) -> Step:
        """Take actions (N, a), clipped to [-1, 1]; an environment with a non-finite action ends as unstable.

        Returns observations (N, d), rewards (N,), float32; terminated and truncated (N,), bool, never both; info.
        """
        ...

    def state_dict(self) -> State:
        """Return copies of the tensors and plain values from which the world continues bit for bit."""
        ...

    def load_state_dict(self, state: State, /) -> None:
        """Restore a ``state_dict`` of a world made in the same way; the world may then be stepped without a reset."""
        ...

    def close(self) -> None:
        """Free the world's resources."""
        ...


@runtime_checkable
class TaskWorld(VectorWorld, Protocol):
    """A world whose environments play known tasks of their slot's pool: for evaluation and meta-learning."""

    slot_env_ids: list[slice]
    """Contiguous environments of each slot, as slices."""
    num_slot_tasks: list[int]
    """Tasks in the pool of each slot."""
    task_index: Tensor
    """Task of its slot's pool that each environment plays, int64 (N,). In DISABLED mode and in ML suites environment j
    of a slot keeps task j mod n; elsewhere each episode may draw one."""
    max_episode_steps: Tensor
    """Time limit of each environment, int64 (N,)."""
    success_at_end: bool
    """True if an episode must hold its goal at the end to be a success; else it must meet the goal at any step."""


@runtime_checkable
class PooledWorld(TaskWorld, Protocol):
    """A world that can be given other tasks."""

    @property
    def pools(self) -> list[np.ndarray]:
        """Tasks of each slot, each (n, size of a variation)."""
        ...

    def set_tasks(self, pools: dict[str, np.ndarray], /) -> None:
        """Replace the task pools of the named slots. The next reset must include all environments.

        Environment j of a slot plays task j mod n if tasks are fixed. Raises BidexError for an unknown slot, a wrong
        shape, or non-finite numbers.
        """
        ...


class EndlessWorld(Protocol):
    """A world whose suite has no fixed number of train tasks (``tasks_per_class = 0``).

    In SAME_STEP and NEXT_STEP mode every episode draws a new task, until ``set_tasks`` gives others. In DISABLED mode
    the pools stay, and a learner that plays trials calls ``fresh_tasks`` and ``set_tasks`` before each trial.
    """

    endless: bool
    """True if training draws tasks without number. Worlds with a fixed number have False, or no such attribute."""

    def fresh_tasks(self, number: int, count: int, /) -> dict[str, np.ndarray]:
        """Return ``count`` new tasks of each slot, for ``set_tasks``; each ``number`` (0, 1, ...) gives other tasks.

        ``number`` and the world's own seed determine the tasks. None of them is in a pool of the suite.
        """
        ...


class PrivilegedWorld(Protocol):
    """A world that can show what its observations hide: for teachers, and for learners that are taught in training.

    Hidden values are the numbers of a task that its class hides (such as the goal's position), scaled from their range
    to [-1, 1]. If a class hides fewer than ``hidden_size`` numbers, zeros follow.
    """

    @property
    def hidden_size(self) -> int:
        """Maximum number of values that the tasks of a class hide; 0 if observations show the goals."""
        ...

    @property
    def hidden_columns(self) -> dict[str, list[int]]:
        """Columns of the tasks in each slot's pool that are hidden, by the slot's name."""
        ...

    def hidden_values(self) -> Tensor:
        """Return the hidden values of the task that each environment plays, float32 (N, hidden_size)."""
        ...

    def rewards_if(self, goals: Tensor, /) -> Tensor:
        """Return the rewards that the last step would have earned if the tasks had other hidden values.

        ``goals`` (..., N, hidden_size); returns (..., N), float32. Raises BidexError for another shape.
        """
        ...

    def with_goals(self, obs: Tensor, /) -> Tensor:
        """Return a copy of the present observations (N, d) in which the hidden goals are visible."""
        ...

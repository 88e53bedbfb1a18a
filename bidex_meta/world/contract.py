"""The interface of batched worlds: learners, evaluation and clients may rely on this docstring and nothing else.

``tests/test_contract.py`` checks every world against this docstring. A world has N environments. Each belongs to one
slot: a task class of the suite, or in MT1 a task of the class. All tensors are on ``device``. A reset or step returns
tensors that the caller owns: no later step changes them, and changes to them or to the given action do not affect the
world.

There are three modes (``metadata["autoreset_mode"]``). In SAME_STEP (training) an environment whose episode ends starts
its next episode within the step: the returned observation is the first of the new episode, and ``info["final_obs"]``
has the last observation of the old episode. In DISABLED (evaluation, meta-learning) an environment whose episode has
ended is frozen: it may be stepped, but it keeps its observation and flags and gets reward 0, until a ``reset`` whose
``reset_mask`` includes it. Gymnasium's tools expect NEXT_STEP, which none of our learners uses: in this mode the step
after the end of an episode ignores the environment's action, starts the next episode and returns reward 0.

The ``info`` of a reset is empty, or has only the key ``pixels`` if the world draws pictures. The ``info`` of a step
describes the transition just made:

=====================  ====================  ===========================================================================
key                    shape, type           meaning
=====================  ====================  ===========================================================================
success                (N,), bool            the goal is met in this state; if success counts at the end: the goal has
                                             been met for the last 15 steps
unstable               (N,), bool            physics broke, or the action was not finite: the reward is 0, the episode
                                             is truncated, and learners must not learn from the transition; never true
                                             in a frozen environment
reward_unscaled        (N,), float32         reward before the suite's scale of the class; 0 in a frozen environment
final_obs              (N, d), float32       the observation to which the transition led; after an unstable transition
                                             the last observation before it
_final_obs             (N,), bool            environments whose episode ended in this step: their ``final_obs`` is the
                                             last observation of the episode; in all others ``final_obs`` is the
                                             observation that the step returns (in NEXT_STEP not in the step that
                                             begins an episode)
running                dict of (N,)          the episode so far: r (return, float32), l (length, int64), success (by the
                                             suite's rule, bool; false where physics broke), unscaled (return of
                                             unscaled rewards, float32)
episode_mask           (N,), bool            environments whose episode ended and counts (shortened first episodes do
                                             not count)
=====================  ====================  ===========================================================================

The world decides by the suite's rule whether an episode is a success, and reports it in ``running["success"]``. The
entry of an episode's last step is the success of the episode; the entry of any other step is the success that the
episode would have if it were cut there. Do not combine the success of several steps: if success counts at the end, an
episode can lose it again.

For users of Gymnasium our worlds add the keys ``episode``, ``_episode``, ``final_info`` and ``_final_info``
(``episodes.py``) to steps in which an episode ended. The warp engine adds them to every step, because checking for an
end would make the host wait. Their values are zero in environments that their masks do not mark. ``solved`` says
whether the goal is met in this state, whatever the suite's rule is. A world may add keys like these, ``reward_terms``
and ``pixels``; learners may not rely on them.

Shortened first episodes: in SAME_STEP mode the first episode of each environment, after the first reset and after each
reset with a seed, may begin at a random elapsed step, so that not all episodes end together. These elapsed steps count
towards the time limit. A world with shortened episodes has an attribute ``stagger``; setting it affects the next such
reset.
"""

from dataclasses import dataclass
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
import torch
from gymnasium.spaces import Box
from torch import Tensor

Info = dict[str, Any]
"""Report of a step; the module's docstring explains the keys."""
Options = dict[str, Any]
"""Options of a reset."""
State = dict[str, Any]
"""Tensors and plain values, nested, as a checkpoint holds them."""
Step = tuple[Tensor, Tensor, Tensor, Tensor, Info]
"""Observations, rewards, terminated, truncated, info."""


@dataclass(frozen=True)
class ObservationGroup:
    """A named group of observation entries, such as ``goal``; it is the same in every environment of a world."""

    name: str
    """``right_hand``, ``left_hand``, ``object`` (a class's entries in no other group), ``goal`` (zeros if hidden),
    ``padding``, ``task_id`` (one-hot), ``task`` for entries whose kind differs by slot (in MT4 these are padding in
    three classes and the second egg in one), or ``last_step`` (in worlds of trials: the last action, the last reward,
    and 1 if an episode ended). Worlds that know no such kinds have one group ``state``. The groups depend on the
    classes: the two splits of ML4 have different groups."""
    where: tuple[slice, ...]
    """Index ranges in ascending order; no two are adjacent."""

    @property
    def size(self) -> int:
        """Number of entries."""
        return sum(part.stop - part.start for part in self.where)


def plain_groups(size: int, num_id_columns: int) -> tuple[ObservationGroup, ...]:
    """Return the observation groups of a world that does not distinguish hands, objects and goals.

    The last ``num_id_columns`` of the ``size`` entries are the group ``task_id``. The other entries are the group
    ``state``.
    """
    groups = (("state", slice(0, size - num_id_columns)), ("task_id", slice(size - num_id_columns, size)))
    return tuple(ObservationGroup(name, (where,)) for name, where in groups if where.stop > where.start)


@runtime_checkable
class VectorWorld(Protocol):
    """N environments that are stepped together; each belongs to one of ``num_tasks`` slots."""

    single_observation_space: Box
    """Observations of one environment: shape (d,), float32. ``observation_space`` has shape (N, d)."""
    single_action_space: Box
    """Actions of one environment: shape (a,), within [-1, 1]. ``action_space`` has shape (N, a)."""
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
    """Discount factor per step that learners must use for each slot; None means that learners use their own."""
    num_id_columns: int
    """Number of entries at the end of an observation that are the one-hot of the slot: ``num_tasks`` or 0."""
    observation_groups: tuple[ObservationGroup, ...]
    """The named parts of an observation, in the order of their first entries; each entry belongs to one group."""
    metadata: dict[str, Any]
    """The entry ``autoreset_mode`` is Gymnasium's SAME_STEP, NEXT_STEP or DISABLED."""

    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[Tensor, Info]:
        """Start episodes; return observations (N, d), float32, and an empty info.

        Args:
            seed: Restarts all draws: equal seeds and actions give equal trajectories. None continues with the old
                seed's next episodes.
            options: ``reset_mask``: environments to start, bool (N,), all by default; the others stay unchanged.

        Raises BidexError for any other option, for a seed below 0, or if a seed is given with a mask that does not
        include all environments.
        """
        ...

    def step(self, action: Tensor, /) -> Step:
        """Apply actions (N, a), which the world clips to [-1, 1], for one control step.

        In an environment with a non-finite action the episode ends as unstable. Returns observations (N, d) and rewards
        (N,), float32; terminated and truncated (N,), bool, of which at most one is true; and info.
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
    """A world in which every environment plays a known task from its slot's pool of tasks.

    Evaluation and meta-learning need such worlds, because they must know which task each environment plays.
    """

    slot_env_ids: list[slice]
    """Contiguous environments of each slot, as slices."""
    num_slot_tasks: list[int]
    """Number of tasks in the pool of each slot."""
    task_index: Tensor
    """Index of the task that each environment plays, in the pool of its slot, int64 (N,). In DISABLED mode and in ML
    suites environment j of a slot keeps task j mod n; otherwise each episode may draw a task."""
    max_episode_steps: Tensor
    """Time limit of each environment, control steps, int64 (N,)."""
    success_at_end: bool
    """True if an episode is a success only if it holds its goal at the end; False if it may meet the goal at any step.
    """


@runtime_checkable
class PooledWorld(TaskWorld, Protocol):
    """A world whose tasks can be replaced."""

    @property
    def pools(self) -> list[np.ndarray]:
        """Task pools: one array (n, size) for each slot, with one row of numbers (the variation) per task."""
        ...

    def set_tasks(self, pools: dict[str, np.ndarray], /) -> None:
        """Replace the task pools of the named slots. The next reset must include all environments.

        Environment j of a slot plays task j mod n if tasks are fixed. Raises BidexError for an unknown slot, a wrong
        shape, or non-finite numbers.
        """
        ...


def as_endless(world: object) -> "EndlessWorld | None":
    """Return the world if its suite has no fixed number of train tasks, otherwise None."""
    if getattr(world, "endless", False):
        return cast(EndlessWorld, world)
    return None


class EndlessWorld(Protocol):
    """A world of a suite that has no fixed number of train tasks (``tasks_per_class = 0``).

    In SAME_STEP and NEXT_STEP mode every episode draws a new task; after a call of ``set_tasks``, episodes play the
    given tasks instead. In DISABLED mode each pool stays until it is replaced. A learner that plays trials (several
    episodes of one task) therefore calls ``fresh_tasks`` and ``set_tasks`` before each trial.
    """

    endless: bool
    """True if training draws an unlimited number of tasks. Worlds with a fixed number have False, or no such attribute.
    """

    def fresh_tasks(self, number: int, count: int, /) -> dict[str, np.ndarray]:
        """Return ``count`` new tasks of each slot, for ``set_tasks``.

        ``number`` (0, 1, ...) and the seed with which the world was made determine the tasks; another number gives
        other tasks. None of the tasks is in a pool of the suite.
        """
        ...


class PrivilegedWorld(Protocol):
    """A world that can show what its observations hide.

    It serves teachers, and learners that use the hidden values in training only.

    Hidden values are the numbers of a task that its class hides (such as the goal's position), scaled from their range
    to [-1, 1]. If a class hides fewer than ``hidden_size`` numbers, zeros follow.
    """

    @property
    def hidden_size(self) -> int:
        """Maximum number of values that the tasks of a class hide; 0 if observations show the goals."""
        ...

    @property
    def hidden_columns(self) -> dict[str, list[int]]:
        """Columns of each slot's task pool that hold hidden numbers, by the slot's name."""
        ...

    def hidden_values(self) -> Tensor:
        """Return the hidden values of the task that each environment plays, float32 (N, hidden_size)."""
        ...

    def rewards_if(self, goals: Tensor, /) -> Tensor:
        """Return the rewards that the last step would have earned if the tasks had other hidden values.

        ``goals`` (..., N, hidden_size) are these hidden values. Returns (..., N), float32. Raises BidexError for
        another shape.
        """
        ...

    @property
    def goal_entries(self) -> Tensor:
        """Indices of the entries of an observation that would show the goal, int64 (e,); empty if nothing is hidden."""
        ...

    def with_goals(self, obs: Tensor, goals: Tensor | None = None, /) -> Tensor:
        """Return a copy of the present observations (N, d) in which the hidden goals are visible.

        With ``goals`` (..., N, hidden_size), the observations (..., N, d) show the goals of tasks with these hidden
        values instead. Raises BidexError for another shape.
        """
        ...

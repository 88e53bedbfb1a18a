"""What a batched world is to learners, evaluation and clients: the one page that says what they may rely on.

``tests/test_contract.py`` holds every world to it: ``World`` in both modes on MT and ML suites, Meta-World's, and the
small worlds of the tests. N rows ("environments"), each of one slot (a task class of the suite; MT1 and ML1: a task of
their class). All tensors are on ``device``; what a step returns is fresh memory that no later step changes.

Modes (``autoreset_mode``): in SAME_STEP (training) a row that ends starts its next episode within the step; the
observation returned is already that of the new episode, ``info["final_obs"]`` has the last one. In DISABLED
(evaluation, meta-learning) an ended row is frozen: it may be stepped, keeps its flags and gets reward 0, until a
``reset`` whose ``reset_mask`` names it.

``info`` of a step, every entry about the transition just made:

=================  ================  ===================================================================================
key                shape, type       meaning
=================  ================  ===================================================================================
success            (N,), bool        the goal is met in this state
unstable           (N,), bool        physics broke: reward 0, truncated, the transition teaches nothing
reward_unscaled    (N,), float32     reward before the suite's scale of the class
final_obs          (N, d), float32   the observation that the transition led to
_final_obs         (N,), bool        rows that ended in this step: there ``final_obs`` is the last of the episode
episode            dict of (N,)      r (return), l (length), success, unscaled, of the episode so far
_episode           (N,), bool        rows whose episode ended and counts (shortened first ones do not)
=================  ================  ===================================================================================

A world may add keys (``reward_terms``, ``final_info``); nobody may rely on these.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class ObservationGroup:
    """Entries of an observation that belong together.

    Attributes:
        name: ``right_hand``, ``left_hand``, ``object`` (what is left beside the others), ``goal``, ``padding`` or
            ``task_id`` (one-hot); worlds that know no such parts call everything before the task id ``state``.
        where: Index ranges, in ascending order.
    """

    name: str
    where: tuple[slice, ...]

    @property
    def size(self) -> int:
        """Number of entries."""
        return sum(part.stop - part.start for part in self.where)


@runtime_checkable
class VectorWorld(Protocol):
    """Rows that are stepped together.

    Attributes:
        single_observation_space: Box of shape (d,).
        single_action_space: Box of shape (a,), within [-1, 1].
        num_envs: Rows, N.
        device: Of all tensors.
        num_tasks: Slots.
        task_id: Slot of each row, ascending, int64 (N,).
        task_names: Names of the slots.
        num_id_columns: Trailing entries of an observation that are the one-hot of the slot: ``num_tasks``, or 0 where
            the task is hidden or alone.
        metadata: Holds ``autoreset_mode``.
    """

    single_observation_space: Any
    single_action_space: Any
    num_envs: int
    device: torch.device
    num_tasks: int
    task_id: Tensor
    task_names: list[str]
    num_id_columns: int
    metadata: dict[str, Any]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        """Starts episodes.

        Args:
            seed: Starts all draws anew, together with a full reset; None goes on with the old seed's next episodes.
            options: ``reset_mask``: which rows to start, bool (N,); all by default.

        Returns:
            Observations (N, d) and info.
        """
        ...

    def step(self, action: Tensor, /) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Takes actions (N, a): observations (N, d), rewards (N,), terminated (N,), truncated (N,), info."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Tensors and numbers from which it continues bit for bit, copied."""
        ...

    def load_state_dict(self, state: dict[str, Any], /) -> None:
        """Puts back what ``state_dict`` gave, on a world made alike."""
        ...


@runtime_checkable
class TaskWorld(VectorWorld, Protocol):
    """A world whose rows play known tasks of their slot's pool: for evaluation and meta-learning.

    Attributes:
        slot_rows: Rows of each slot, contiguous.
        num_slot_tasks: Tasks in the pool of each slot.
        task_index: Task of its slot's pool that each row plays, int64 (N,); in worlds whose tasks are fixed row j of a
            slot plays task j mod n.
        max_episode_steps: Time limit of each row, int64 (N,).
    """

    slot_rows: list[slice]
    num_slot_tasks: list[int]
    task_index: Tensor
    max_episode_steps: Tensor


@runtime_checkable
class PooledWorld(TaskWorld, Protocol):
    """A world that can be given other tasks.

    Attributes:
        pools: Tasks of each slot, each (n, size of a variation).
    """

    pools: list[np.ndarray]

    def set_tasks(self, pools: dict[str, np.ndarray], /) -> None:
        """Gives slots other pools; row j of a slot plays task j mod n from the next full reset on."""
        ...


def observation_groups(world: VectorWorld) -> tuple[ObservationGroup, ...]:
    """The named groups of a world's observation, in the order of their first entries; they cover it.

    A world says so itself by an attribute ``observation_groups``; of one that does not, the last ``num_id_columns`` are
    the task id and the rest is ``state``.
    """
    own = getattr(world, "observation_groups", None)
    if own is not None:
        return own
    size, columns = int(world.single_observation_space.shape[0]), world.num_id_columns
    state = ObservationGroup("state", (slice(0, size - columns),))
    return (state, ObservationGroup("task_id", (slice(size - columns, size),))) if columns else (state,)

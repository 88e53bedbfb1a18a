"""The data set from which a student learns: the newest observations of each environment, labelled by teachers.

The data set is a ring buffer of vector steps on the device, in half precision; a vector step is one step of all
environments. 1.5 M observations of MT20-v2 with their labels take 1.6 GB.
"""

import torch
from torch import Tensor

from bidex_meta.errors import BidexError
from bidex_meta.training.learner import State


class Labelled:
    """Labelled observations of the last ``steps`` vector steps in the environments with the indices ``rows`` (L,).

    A vector step is one step of all environments. ``task_id`` (L,) is the task of each environment in ``rows``, in
    ascending order. ``tasks`` (K,) are the tasks that have an environment in ``rows``.
    """

    def __init__(self, steps: int, rows: Tensor, task_id: Tensor, observations: int, actions: int):
        self.steps = steps
        self.rows = rows
        self.added = 0
        self.tasks, self._count = torch.unique_consecutive(task_id, return_counts=True)
        self._first = self._count.cumsum(0) - self._count
        half = {"dtype": torch.float16, "device": rows.device}
        # The ring is not filled: memory is allocated at the first write, and no entry is read earlier.
        self._obs = torch.empty(steps, len(rows), observations, **half)
        self._labels = torch.empty(steps, len(rows), actions, **half)

    @property
    def filled(self) -> int:
        """Return the number of stored vector steps; a vector step is one step of all environments."""
        return min(self.added, self.steps)

    def add(self, obs: Tensor, labels: Tensor) -> None:
        """Store the observations and labels of one step of all environments.

        ``obs`` (N, d) are raw observations and ``labels`` (N, a) are teachers' actions in the N environments of the
        world. Only the environments in ``rows`` are stored.
        """
        self._obs[self.added % self.steps] = obs[self.rows]
        self._labels[self.added % self.steps] = labels[self.rows]
        self.added += 1

    def draw(self, batches: int, per_task: int, generator: torch.Generator) -> Tensor:
        """Draw indices uniformly within each task: int64 (batches, K * per_task), ordered by task."""
        shape = (batches, len(self.tasks), per_task)
        device = self.rows.device
        step = torch.randint(self.filled, shape, generator=generator, device=device)
        # A remainder of this large number favours no row by more than 1 in 2^40 / rows.
        row = torch.randint(2**40, shape, generator=generator, device=device) % self._count[:, None]
        return (step * len(self.rows) + self._first[:, None] + row).flatten(1)

    def take(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Return observations (B, d) and labels (B, a) at the indices ``places`` (B,), float32."""
        return tuple(ring.flatten(0, 1).index_select(0, places).float() for ring in (self._obs, self._labels))  # type: ignore[return-value]

    def of_last(self, steps: int) -> list[Tensor]:
        """Return the labels of the newest ``steps`` vector steps, one tensor per task: (n, a), float32."""
        last = (self.added - 1 - torch.arange(steps, device=self.rows.device)) % self.steps
        return [part.flatten(0, 1).float() for part in self._labels[last].split(self._count.tolist(), dim=1)]

    def state_dict(self) -> State:
        """Return a copy of the stored data."""
        kept = {"obs": self._obs[: self.filled].clone(), "labels": self._labels[: self.filled].clone()}
        return {"added": self.added, "steps": self.steps, "rows": self.rows.clone(), **kept}

    def load_state_dict(self, state: State) -> None:
        """Restore the result of :meth:`state_dict`; raise BidexError if ``state`` has other environments or sizes."""
        here = (self.steps, self.rows.tolist())
        there = (state["steps"], state["rows"].tolist())
        if here != there:
            raise BidexError(
                f"The checkpoint's data set keeps {there[0]} steps of {len(there[1])} environments, this one {here[0]} "
                f"of {len(here[1])}. Resume with the run's own suite, teachers, num_envs and samples."
            )
        self.added = int(state["added"])
        for name, ring in (("obs", self._obs), ("labels", self._labels)):
            ring[: self.filled] = state[name].to(ring.device)
